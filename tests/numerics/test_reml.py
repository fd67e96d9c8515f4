"""Variance components against what was drawn and the Gaussian integral.

Posterior means of variances against an integral on a grid.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp
from scipy.stats import halfcauchy

from stitch.numerics import reml
from stitch.numerics.common_covariance import SelectedColumns, common_covariance
from stitch.numerics.least_squares import invert_covariance
from stitch.numerics.reml import (
    ALWAYS_PRESENT,
    MAY_BE_ABSENT,
    FurtherColumns,
    FurtherPrior,
    Likelihood,
    MixedModel,
    VarianceFit,
    at_variances,
    deviance,
    fisher_scoring,
    fit_variances,
    log_density,
    model_information,
    reml_problem,
)
from stitch.numerics.variance_posterior import mean_variances, satterthwaite

N, SCALE = 40, 0.5


def test_variances_are_found_again():
    """Components of known size: the mean estimate over 40 draws within three standard errors."""
    rng = np.random.default_rng(0)
    n, found = 90, []
    a, b = rng.standard_normal((2, n, n)) / np.sqrt(n)
    C = np.array([a @ a.T, b @ b.T, np.eye(n)])[:, None]
    A = rng.standard_normal((1, n, 5))
    truth = np.array([4.0, 2.0, 1.0])
    half = np.linalg.cholesky(np.einsum("c,cij->ij", truth, C[:, 0]))
    for _ in range(40):
        z = half @ rng.standard_normal(n) + A[0] @ rng.normal(0, 30, 5)
        found.append(fit_variances(MixedModel(z[None], A, C)).variances)
    mean, error = np.mean(found, axis=0), np.std(found, axis=0) / np.sqrt(len(found))
    # The prior off the boundary lifts the first two by about a standard deviation of one estimate at most.
    assert (mean - truth < 3 * error + np.std(found, axis=0)).all()
    assert (truth - mean < 3 * error).all()


@pytest.mark.parametrize("n", [100, 300])
def test_steps_by_the_average_information_end_where_a_search_ends(monkeypatch, n):
    """Of n numbers in one block: deviances within 0.01, variances within a twentieth of their standard errors."""
    rng = np.random.default_rng(7)
    truth = np.array([2.0, 0.5, 1.0])
    a, b = rng.standard_normal((2, n, n // 3)) / np.sqrt(n / 3)
    C = np.array([a @ a.T, b @ b.T, np.diag(rng.uniform(0.2, 2.0, n))])[:, None]
    A = rng.standard_normal((1, n, 6))
    half = np.linalg.cholesky(np.einsum("c,cij->ij", truth, C[:, 0]))
    mixed = MixedModel((half @ rng.standard_normal(n))[None], A, C)
    steps = []
    likelihood = reml.likelihood
    monkeypatch.setattr(reml, "likelihood", lambda *given: steps.append(1) or likelihood(*given))
    stepped, count = fit_variances(mixed), len(steps)
    monkeypatch.setattr(reml, "fisher_scoring", lambda *_: None)
    searched = fit_variances(mixed)
    assert count < (len(steps) - count) / 2
    assert abs(stepped.deviance - searched.deviance) < 0.01
    W = np.linalg.inv(mixed.covariance(searched.variances)[0])
    information = np.einsum("iab,jba->ij", W @ C[:, 0], W @ C[:, 0]) / 2
    assert (abs(stepped.variances - searched.variances) < np.sqrt(np.diag(np.linalg.inv(information))) / 20).all()


def test_evidence_is_the_gaussian_integral():
    """Integrating θ out by hand gives the same likelihood as the covariance V + G S Gᵀ."""
    rng = np.random.default_rng(1)
    n = 30
    C = np.array([np.diag(rng.uniform(0.5, 1, n)) for _ in range(3)])[:, None]
    z, A, G = rng.standard_normal((1, n)), rng.standard_normal((1, n, 2)), rng.standard_normal((1, n, 3))
    prior = np.array([0.5, 1.0, 2.0])
    variances = np.array([1.0, 0.7, 1.3])
    plain, wide = (at_variances(MixedModel(z, A, c), variances) for c in (C, C))
    with_G = at_variances(MixedModel(z, A, C), variances, G, prior)
    V = np.einsum("c,cij->ij", variances, C[:, 0])
    values = []
    for K in (V, V + (G[0] * prior**2) @ G[0].T):
        W = np.linalg.inv(K)
        M = A[0].T @ W @ A[0]
        P = W - W @ A[0] @ np.linalg.solve(M, A[0].T @ W)
        values.append(np.linalg.slogdet(K)[1] + np.linalg.slogdet(M)[1] + z[0] @ P @ z[0])
    assert with_G.deviance - plain.deviance == pytest.approx(values[1] - values[0], abs=1e-8)
    assert wide.deviance == plain.deviance


def test_scatter_that_no_number_has_is_none():
    """Without scatter of poses it is ordinary regression: (n − a) log λ + RSS/λ and the log-normal prior of the factor."""
    rng = np.random.default_rng(2)
    n, a = 40, 3
    C = np.zeros((3, 1, n, n))
    C[2, 0] = np.eye(n)
    A, z = rng.standard_normal((1, n, a)), 2 * rng.standard_normal((1, n))
    mean, (square,), *_ = np.linalg.lstsq(A[0], z[0], rcond=None)
    own = minimize_scalar(
        lambda x: (n - a) * x + square * np.exp(-x) + ((x - np.log(2)) / 1.5) ** 2,
        bounds=(-5, 5),
        options={"xatol": 1e-9},
    )
    found = fit_variances(MixedModel(z, A, C), both_starts=True)
    assert found.variances[:2].tolist() == [0, 0]
    assert found.variances[2] == pytest.approx(np.exp(own.x), rel=1e-4)
    assert found.mean == pytest.approx(mean, rel=1e-9)
    # Other columns are compared at the same constants.
    more = fit_variances(MixedModel(z, A, C), A[..., :1] ** 2, np.ones(1), start=found.variances)
    assert np.isfinite(more.deviance - found.deviance) and more.variances[:2].tolist() == [0, 0]


def test_variances_beyond_all_numbers_are_as_unlikely_as_nothing_else():
    mixed = MixedModel(np.ones((1, 4)), np.zeros((1, 4, 0)), np.eye(4)[None, None])
    for log_variance in (800.0, np.nan):
        value, slope = deviance(np.array([log_variance]), reml_problem(mixed, None, None))
        assert value == 1e300 and not slope.any()


def test_one_block_is_inverted_as_many_are():
    half = np.random.default_rng(4).normal(size=(2, 7, 7))
    V = half @ half.transpose(0, 2, 1) + np.eye(7)
    both, alone = invert_covariance(V), [invert_covariance(V[:1]), invert_covariance(V[1:])]
    assert sum(one.logdet for one in alone) == pytest.approx(both.logdet)
    assert both.logdet == pytest.approx(np.linalg.slogdet(V)[1].sum())
    for b, one in enumerate(alone):
        for own in (one.matrix[0], both.matrix[b]):
            assert np.allclose(own @ V[b], np.eye(7), atol=1e-12)
        for own in (one.half[0], both.half[b]):
            assert np.allclose(own @ V[b] @ own.T, np.eye(7), atol=1e-12)
            assert not np.triu(own, 1).any()
    assert invert_covariance(-V[:1]).logdet == invert_covariance(-V).logdet == np.inf


@pytest.mark.parametrize("shape", [None, MAY_BE_ABSENT, ALWAYS_PRESENT])
def test_scoring_ends_where_a_search_ends(shape):
    """Sixty blocks go by scoring, to where a search with scipy ends; from far away it may leave that to the search.

    Args:
        shape: of the prior of a fourth component, if there is one.
    """
    rng = np.random.default_rng(12)
    m, blocks = 4, 60
    half = rng.normal(size=(2, blocks, m, 3))
    components = np.array([h @ h.transpose(0, 2, 1) for h in half] + [np.tile(1e-2 * np.eye(m), (blocks, 1, 1))])
    true, further = np.array([0.5, 0.02, 1.5]), None
    if shape is not None:
        own = rng.normal(size=(blocks, m, 3))
        components, true = np.concatenate([components, (own @ own.transpose(0, 2, 1))[None]]), np.append(true, 0.1)
        further = FurtherPrior(np.array([0.3]), np.array([shape]), np.zeros(1, bool))
    V = np.einsum("c,cbij->bij", true, components)
    z = np.einsum("bij,bj->bi", np.linalg.cholesky(V), rng.normal(size=(blocks, m)))
    problem = reml_problem(MixedModel(z, np.ones((blocks, m, 1)), components, further=further), None, None)
    for factor in (1.0, 30.0, 0.05):
        begin = np.log(true * [factor, 1 / factor, *np.ones(len(true) - 2)])
        found = fisher_scoring(problem, begin, 1e-3)
        looked = minimize(
            lambda x: deviance(x, problem),
            begin,
            jac=True,
            method="L-BFGS-B",
            options={"gtol": 1e-6, "ftol": 1e-14},
        )
        assert found is not None or factor != 1.0
        if found is not None:
            assert found.deviance == deviance(found.log_variances, problem)[0] == pytest.approx(looked.fun, abs=2e-3)


def test_a_step_goes_as_far_as_the_prior_bends(monkeypatch):
    """Noise far below the scatter, held up by its prior: a step that takes the prior's slope for nothing goes too far,
    is halved and comes back, and the search takes half as many evaluations again."""
    rng, evaluated, evaluate = np.random.default_rng(5), list[Likelihood](), reml.likelihood
    half = rng.normal(size=(2, 400, 6, 3))
    components = np.array([h @ h.transpose(0, 2, 1) for h in half] + [np.tile(0.03 * np.eye(6), (400, 1, 1))])
    V = np.einsum("c,cbij->bij", [0.5, 0.3, 0.01], components)
    z = np.einsum("bij,bj->bi", np.linalg.cholesky(V), rng.normal(size=(400, 6)))
    problem = reml_problem(MixedModel(z, np.ones((400, 6, 1)), components), None, None)
    monkeypatch.setattr(reml, "likelihood", lambda *args: evaluated.append(evaluate(*args)) or evaluated[-1])
    found = fisher_scoring(problem, np.log([0.5, 0.3, 0.1]), 1e-3)
    assert found is evaluated[-1] and len(evaluated) <= 4
    deviances = [own.deviance for own in evaluated]
    assert deviances == sorted(deviances, reverse=True)  # none was too far


def turned_blocks(rng, count=80, targets=3):
    """Views of targets on a flange that is turned anew in each; some miss one, and numbers of known variance follow."""
    at = rng.normal(0, 100, (targets, 3))
    lever = np.concatenate([np.concatenate([np.cross(np.eye(3), p).T, np.eye(3)], axis=1) for p in at])
    turns = Rotation.random(count, rng).as_matrix()
    every = np.concatenate([turns @ lever[3 * i : 3 * i + 3] for i in range(targets)], axis=1)
    noise, known = np.full((count + 2, 3 * targets), 0.04), np.zeros((count + 2, 3 * targets))
    noise[:30, -3:] = noise[count:] = 0.0
    known[:30, -3:] = 1.0
    known[count:] = 0.3
    every[:30, -3:] = 0.0
    return [every[..., :3], every[..., 3:]], noise, known


def model_of_turned_blocks(rng, scattered, noise, known):
    """A mixed model of such blocks, and its three further columns."""
    components = np.zeros((3, *noise.shape, noise.shape[1]))
    for own, J in zip(components, scattered, strict=False):
        own[: len(J)] = J @ J.transpose(0, 2, 1)
    components[2] = noise[..., None] * np.eye(noise.shape[1])
    there = (noise > 0) | (np.arange(len(noise)) >= len(scattered[0]))[:, None]
    z, A, G = (rng.standard_normal((*noise.shape, k)) * there[..., None] for k in (1, 4, 3))
    fixed = known[..., None] * np.eye(noise.shape[1])
    return MixedModel(z[..., 0], A, components, fixed, common=common_covariance(scattered, noise, known)), G


@pytest.mark.parametrize("prior", [None, np.array([0.3, 1.0, 2.0])])
def test_sums_over_common_covariance_are_those_of_every_block(prior):
    """Likelihood, slope, curvature, mean and fit as of the blocks one by one; columns taken into the mean too."""
    rng = np.random.default_rng(3)
    mixed, G = model_of_turned_blocks(rng, *turned_blocks(rng))
    assert mixed.common is not None
    assert len(mixed.common.groups) == 2
    x, single = np.log([1e-5, 0.02, 1.7]), replace(mixed, common=None)
    of_groups, of_blocks = (reml.likelihood(x, reml_problem(own, G, prior)) for own in (mixed, single))
    for value in ("deviance", "slope", "curvature", "mean", "covariance", "sums"):
        assert getattr(of_groups, value) == pytest.approx(getattr(of_blocks, value), rel=1e-8, abs=1e-8)
    fits = [fit_variances(own, G, prior, start=np.exp(x)).variances for own in (mixed, single)]
    assert fits[0] == pytest.approx(fits[1], rel=1e-6)
    # Columns taken into the mean, held for further ones or not; and what is told of others beside them.
    anew = replace(single, A=np.concatenate([mixed.A, G], axis=2))
    flat, other = G.reshape(mixed.z.size, -1), SelectedColumns(rng.standard_normal((mixed.z.size, 2)), np.ones(2, bool))
    for columns in (SelectedColumns(flat), SelectedColumns(np.hstack([flat, flat]), np.arange(6) < 3)):
        taken_in = FurtherColumns(mixed, (columns,)).in_mean()
        fits = [at_variances(own, np.exp(x)) for own in (taken_in, anew)]
        assert fits[0].deviance == pytest.approx(fits[1].deviance, rel=1e-10)
        more = [at_variances(taken_in, np.exp(x), FurtherColumns(taken_in, (other,)))]
        more.append(at_variances(anew, np.exp(x), other.whole.reshape(*mixed.z.shape, -1)))
        assert more[0].deviance == pytest.approx(more[1].deviance, rel=1e-10)
        if not taken_in.sums.are_cached:
            continue
        told, vector = model_information(taken_in, fits[0]).of(other)
        half = np.linalg.inv(np.linalg.cholesky(single.covariance(np.exp(x))))
        A, X, z = (
            (half @ own.reshape(*mixed.z.shape, -1)).reshape(mixed.z.size, -1) for own in (anew.A, other.whole, mixed.z)
        )
        left = X - A @ np.linalg.lstsq(A, X)[0]
        assert told == pytest.approx(left.T @ left, rel=1e-8)
        assert vector == pytest.approx(left.T @ z[:, 0], rel=1e-8)


def test_blocks_that_differ_are_summed_one_by_one():
    """Targets elsewhere on one flange, or a number without noise that scatters: no groups."""
    scattered, noise, known = turned_blocks(np.random.default_rng(4))
    moved = [own.copy() for own in scattered]
    moved[0][50] *= 1.001
    assert common_covariance(moved, noise, known) is None
    quiet = noise.copy()
    quiet[60, 0] = 0.0
    assert common_covariance(scattered, quiet, known) is None


def shared_errors(size: float, seed: int = 3, kin: bool = False, shape: float = MAY_BE_ABSENT) -> MixedModel:
    """Numbers of known noise with an error in common to fives of them, about one unknown mean.

    Args:
        kin: its usual size is known to a factor only.
    """
    rng = np.random.default_rng(seed)
    groups = np.repeat(np.eye(N // 5), 5, axis=0)
    z = 1.0 + rng.standard_normal(N) + size * groups @ rng.standard_normal(N // 5)
    # Of the first two components there is nothing; the noise is there with a factor near two.
    components = np.array([np.zeros((N, N)), np.zeros((N, N)), 0.5 * np.eye(N), groups @ groups.T])[:, None]
    prior = FurtherPrior(np.array([SCALE]), np.array([shape]), np.array([kin]))
    return MixedModel(z[None], np.full((1, N, 1), N**-0.5), components, further=prior)


def on_a_grid(mixed: MixedModel) -> np.ndarray:
    """The same by brute force, down to where nearly nothing lies below: flat prior of the mean, densities of scipy, priors of the variances written out."""
    noise, group = np.meshgrid(np.linspace(-1.0, 3.0, 25), np.arange(-100, 7, 0.5), indexing="ij")
    logs, ones = [], np.ones(N)
    kin, (shape,) = mixed.further.common_factor[0], mixed.further.shapes
    # Of arms that are known to a factor half err by more than three usual sizes.
    factors = np.linspace(np.log(0.01), np.log(30), 60) if kin else np.zeros(1)
    of_factor = halfcauchy(scale=3).logpdf(np.exp(factors)) + factors if kin else np.zeros(1)
    for a, b in zip(noise, group, strict=True):
        V = np.exp(a)[:, None, None] * mixed.components[2, 0] + np.exp(b)[:, None, None] * mixed.components[3, 0]
        weights = np.linalg.solve(V, ones)
        total = weights.sum(axis=1)
        off = mixed.z[0] - (weights @ mixed.z[0] / total)[:, None]
        squares = np.einsum("gi,gi->g", off, np.linalg.solve(V, off[..., None])[..., 0])
        likelihood = -0.5 * (squares + np.linalg.slogdet(V)[1] + np.log(total))
        over = b[:, None] - 2 * np.log(SCALE) - 2 * factors
        further = logsumexp(of_factor + 0.5 * shape * over - 0.5 * (1 + shape) * np.log1p(np.exp(over)), axis=1)
        prior = further - 0.5 * ((a - np.log(2)) / 1.5) ** 2
        logs.extend(likelihood + prior)
    w = np.exp(np.array(logs) - max(logs))
    return np.array([w @ np.exp(noise.ravel()), w @ np.exp(group.ravel())]) / w.sum()


@pytest.mark.parametrize(
    ("size", "kin", "shape"),
    [
        (0.0, False, MAY_BE_ABSENT),
        pytest.param(2.0, False, MAY_BE_ABSENT, marks=pytest.mark.slow),
        pytest.param(0.0, True, MAY_BE_ABSENT, marks=pytest.mark.slow),
        (0.5, True, MAY_BE_ABSENT),
        pytest.param(2.0, True, MAY_BE_ABSENT, marks=pytest.mark.slow),
        pytest.param(0.0, False, ALWAYS_PRESENT, marks=pytest.mark.slow),
        (0.5, False, ALWAYS_PRESENT),
    ],
)
def test_the_average_is_the_integral(size, kin, shape, monkeypatch):
    # 400 rounds know the mean of what spreads by as much as itself to a twentieth; of one size and a factor on it, of
    # which each follows the other, more are asked.
    monkeypatch.setattr("stitch.numerics.variance_posterior._ROUNDS", 2000 if kin else 400)
    mixed = shared_errors(size, kin=kin, shape=shape)
    found = mean_variances(mixed, fit_variances(mixed))
    assert found[2:] == pytest.approx(on_a_grid(mixed), rel=1 / 20, abs=0.01)
    assert (found[:2] == 0).all() or (found[:2] < 1e-100).all()


def test_among_very_many_numbers_the_maximum_must_do(monkeypatch):
    monkeypatch.setattr("stitch.numerics.variance_posterior._NO_ROUNDS", N)
    mixed = shared_errors(1.0)
    fit = fit_variances(mixed)
    assert mean_variances(mixed, fit) == pytest.approx(fit.variances)


def test_a_mean_that_explains_all_numbers_leaves_the_maximum():
    """As many parameters as numbers: views of which hardly anything was seen."""
    mixed = shared_errors(1.0)
    mixed = MixedModel(mixed.z[:, :2], np.eye(2)[None], mixed.components[:, :, :2, :2], further=mixed.further)
    fit = fit_variances(mixed)
    assert mean_variances(mixed, fit) == pytest.approx(fit.variances)


def test_scatter_is_half_cauchy_about_what_arms_repeat_to():
    """Its density per log variance against scipy's, the lowest size with all that is below it."""
    prior = FurtherPrior(np.zeros(0), np.zeros(0), np.zeros(0, bool), (2e-5, 0.02))
    logs = np.arange(-14.0, 4.0, 0.25)
    for component, usual in enumerate((2e-5, 0.02)):
        there = 2 * np.log(usual) + logs
        sigma = np.exp(0.5 * there)
        expected = halfcauchy(scale=usual).logpdf(sigma) + np.log(sigma / 2)
        found = log_density(component, there, prior)
        assert np.ptp((found - expected)[1:]) == pytest.approx(0, abs=1e-9)
        assert np.exp(found[0] - found[1]) * np.exp(expected[1]) * 0.25 == pytest.approx(
            halfcauchy(scale=usual).cdf(np.exp(0.5 * (there[0] + 0.125))), rel=0.02
        )


GROUPS = (30, 20, 500)


def groups() -> tuple[MixedModel, VarianceFit]:
    """Three groups of numbers, each with a variance of its own; the mean of the first is unknown."""
    own = np.repeat(np.arange(3), GROUPS)
    components = np.array([np.diag((own == k).astype(float)) for k in range(3)])[:, None]
    A = (own == 0).astype(float)[None, :, None]
    evidence = MixedModel(np.zeros((1, own.size)), A, components)
    return evidence, VarianceFit(np.array([4.0, 0.25, 1.0]), 0.0, np.zeros(1), np.eye(1), np.eye(2))


@pytest.mark.parametrize(("share", "expected"), [(0.0, 29.0), (1.0, 20.0), (0.5, 1 / (0.25 / 29 + 0.25 / 20))])
def test_a_group_of_numbers_knows_its_own_variance(share, expected):
    """Satterthwaite's formula for a direction within one group, and across two."""
    evidence, null = groups()
    white = np.zeros((1, sum(GROUPS), 1))
    white[0, :2, 0] = np.sqrt((1 - share) / 2) * np.array([1, -1])
    white[0, 30:32, 0] = np.sqrt(share / 2) * np.array([1, -1])
    assert satterthwaite(evidence, null).degrees_of_freedom(white) == pytest.approx(expected, rel=1e-6)
