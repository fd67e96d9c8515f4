"""How much likelier an effect makes the views, against densities by scipy, and where a fit of it begins."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated
from data_synth.scene import load_scene
from stitch.api.pipeline import run
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.score import score, try_form
from stitch.effects.contract import EFFECTS
from stitch.numerics import frames
from stitch.numerics.parameter_selection import ANY_SIZE
from stitch.numerics.reml import log_prior
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
    found = try_form(linear, form, linear.null.variances, scale)
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
