"""How much likelier an effect makes the views, against densities by scipy, and where a fit of it begins.

What views can show of an effect: aliases, and the smallest size that shows, against closed forms and drawn noise.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.special import logsumexp
from scipy.stats import f as f_distribution
from scipy.stats import multivariate_normal, norm

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated
from data_synth.scene import load_scene
from stitch.api.pipeline import run
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.score import score, try_form
from stitch.diagnosis.sensitivity import imitated_share, least_noncentrality
from stitch.diagnosis.thresholds import ALPHA_NAME, LOG_BAYES_FACTOR
from stitch.effects.contract import EFFECTS
from stitch.numerics import frames
from stitch.numerics.parameter_selection import ANY_SIZE
from stitch.numerics.reml import MixedModel, VarianceFit, fit_variances, log_prior
from stitch.numerics.variance_posterior import satterthwaite
from tests.diagnosis.freed_blade import freed_blade

VIEWS = 16


@pytest.fixture(scope="module")
def linear():
    """A mount that drifts by 0.1 mm and 0.1 mrad over the session, some tenths of what would be plausible."""
    cell = freed_blade(7, VIEWS)
    drift = np.linspace(-1, 1, VIEWS)[:, None] * np.array([6e-5, -4e-5, 5e-5, 0.05, -0.06, 0.05])
    return cell.seen(frames.exp(drift) @ cell.measured.T_base_flange)


@pytest.mark.parametrize("scale", ANY_SIZE)
def test_the_gain_is_that_of_all_scales_together_wherever_the_search_begins(linear, scale):
    candidate = candidate_of(linear, EFFECTS["mount_drift"])
    form = candidate.forms[0]
    found = try_form(linear, candidate, form, linear.null.variances, scale)
    free = null_space(linear.mixed.A[0].T).T
    every = [free @ C @ free.T for C in linear.mixed.components[:, 0]]
    fixed, columns = free @ linear.mixed.fixed[0] @ free.T, free @ form.columns

    def likely(variances, sizes):
        covariance = np.tensordot(variances, every, axes=1) + fixed + (columns * sizes**2) @ columns.T
        density = multivariate_normal(cov=covariance).logpdf(free @ linear.mixed.z[0])
        return density - 0.5 * log_prior(np.log(variances), linear.mixed.further)[0]

    with_it = logsumexp([likely(found.variances, s * form.sizes) + np.log(y) for s, y in ANY_SIZE.items()])
    without = likely(linear.null.variances, 0 * form.sizes)
    # The other scales count at the variances of the first search.
    assert found.log_bayes_factor == pytest.approx(with_it - without, abs=0.25)


def test_an_effect_below_what_is_plausible_is_found_at_its_scale(linear):
    candidate = candidate_of(linear, EFFECTS["mount_drift"])
    found = score(linear, candidate)
    assert found.p_value < 1e-5 and found.log_bayes_factor > 3
    assert found.scale < 1


@pytest.mark.slow
def test_a_slip_that_the_run_is_told_of_is_found_where_it_was():
    scene = load_scene("drill-plate")
    scene = replace(scene, scanner=replace(scene.scanner, columns=50, rows=50))
    measured = simulated(scene, {"part_slip": 4.0}, 5, views=12)
    true = measured.hidden["part_slip"]["v"]
    assert true != 6  # the middle, where a fit that does not look would begin
    found = run(session_of(measured), effects=["part_slip"])
    (term,) = found.terms
    (place,) = (p for p in term.parameters if p.name == "v")
    assert place.value == true and str(place.formatted) == session_of(measured).names[int(true)]


def test_a_pattern_in_the_plane_of_two_columns_is_imitated_by_the_cosine_of_its_angle_to_it():
    X = 1e3 * np.eye(5)[:, :2]
    assert imitated_share(np.array([3.0, 4.0, 0, 0, 0]), X) == pytest.approx(1.0, abs=1e-6)
    assert imitated_share(np.array([3.0, 0, 4.0, 0, 0]), X) == pytest.approx(0.6, abs=1e-6)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-310])
def test_a_pattern_that_views_cannot_show_is_like_nothing(size):
    """Patterns so small that products of their lengths vanish."""
    assert imitated_share(size * np.ones(4), np.zeros((4, 2))) == 0.0
    assert imitated_share(size * np.ones(4), 1e-200 * np.ones((4, 1))) == 0.0


def test_known_scatter_and_one_parameter_need_what_two_quantiles_say():
    """With so many tests that the p-value decides: |θ| √I = z(1 − α/2K) + z(0.8)."""
    tests = 1_000_000
    least = least_noncentrality(np.array([[1.0]]), 1.0, tests, 1e7, {1.0: 1.0})
    assert np.sqrt(least) == pytest.approx(norm.isf(ALPHA_NAME / 2 / tests) + norm.ppf(0.8), rel=5e-3)


def test_far_beyond_what_is_needed_nothing_is_asked_of_the_distribution():
    """There its series ends in NaN: scipy's for 898 degrees of freedom, an F of 266 and a shift of 2,496."""
    white = np.full((1760, 1), 30.0)
    least = least_noncentrality(white, 1e-112, 8, 897.9767842812669, {1.0: 1.0})
    assert np.isfinite(least) and least > 500


@pytest.mark.slow
def test_the_smallest_size_shows_in_eight_of_ten():
    """Drawn with few views: the likelihoods and the F test themselves, not the approximation."""
    rng, draws, tests, n, p = np.random.default_rng(3), 250, 20, 36, 3
    components = np.array([np.diag((np.arange(n) < n - 4).astype(float)), np.eye(n) * 1e-6, np.zeros((n, n))])
    components[2][-4:, -4:] = np.eye(4)
    columns = rng.normal(size=(n, p)) * (np.arange(n) < n - 4)[:, None]
    A = np.ones((n, 1))
    free = columns - A @ np.linalg.lstsq(A, columns, rcond=None)[0]
    plausible = MixedModel(np.zeros((1, n)), A[None], components[:, None])
    unit = VarianceFit(np.array([1.0, 1e-9, 1.0]), 0.0, np.zeros(1), np.eye(1), np.eye(2))
    degrees_of_freedom = satterthwaite(plausible, unit).degrees_of_freedom(free[None])
    least = least_noncentrality(free * 2.0, 1.0, tests, degrees_of_freedom, {1.0: 1.0})
    theta = np.ones(p) * np.sqrt(least) / np.linalg.norm(free.sum(axis=1))
    shown = 0
    for _ in range(draws):
        z = columns @ theta + rng.standard_normal(n)
        drawn = MixedModel(z[None], A[None], components[:, None])
        gain = 0.5 * (fit_variances(drawn).deviance - fit_variances(drawn, columns[None], np.full(p, 2.0)).deviance)
        fitted, rest = np.linalg.lstsq(np.hstack([A, columns]), z, rcond=None)[:2]
        square = np.sum((free @ fitted[1:]) ** 2) / p / (rest[0] / (n - 1 - p))
        shown += gain > LOG_BAYES_FACTOR and f_distribution.sf(square, p, degrees_of_freedom) < ALPHA_NAME / tests
    # Four standard errors of a share of 250 draws.
    assert shown / draws == pytest.approx(0.8, abs=0.1)
