"""Posterior means of variances against an integral on a grid."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import halfcauchy

from stitch.numerics.reml import (
    ALWAYS_PRESENT,
    MAY_BE_ABSENT,
    FurtherPrior,
    MixedModel,
    VarianceFit,
    fit_variances,
    log_density,
)
from stitch.numerics.variance_posterior import mean_variances, satterthwaite

N, SCALE = 40, 0.5


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
