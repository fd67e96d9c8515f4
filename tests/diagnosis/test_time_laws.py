"""What a flange does in time by no law of the library: it swings, or stands off for a stretch of views."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from data_synth.ordinary_arm import with_memory
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.thresholds import IMPLAUSIBLE, ODDS
from stitch.diagnosis.unmodelled_time_effects import (
    find_repeating_errors,
    likeliest_time_effect,
    significant_time_effect,
    time_processes,
)
from stitch.effects.contract import EFFECTS
from stitch.numerics import frames
from stitch.numerics.reml import log_prior
from stitch.observations.pose_errors import DRIFT_MEMORY
from tests.diagnosis.freed_blade import freed_blade

VIEWS = 18
# Of the flange in its own frame, rad and mm: 0.4 mrad and 0.12 mm, where poses scatter by 20 µrad and 20 µm.
DIRECTION = np.array([2.2e-4, -1.5e-4, 2.8e-4, 0.08, 0.05, -0.07])
SCATTER = np.array([2e-5, 0.02])
ASKED = ("robot_thermal_growth", "mount_drift", "mount_warmup", "fixture_drift", "part_slip")


@pytest.fixture(scope="module")
def cell():
    """A blade on the flange and its freed views under the true hand-eye."""
    return freed_blade(4, VIEWS)


def linear_of(cell, errors):
    """The views where the flange errs by so much (V, 6), in its own frame."""
    return cell.seen(cell.measured.T_base_flange @ frames.exp(errors))


def verdict_of(linear):
    candidates = [c for name in ASKED if (c := candidate_of(linear, EFFECTS[name])) is not None]
    return gather_evidence(linear, candidates, ScatterLimit(*IMPLAUSIBLE))


@pytest.mark.parametrize(
    "period", [4.0, pytest.param(5.5, marks=pytest.mark.slow), pytest.param(8.0, marks=pytest.mark.slow)]
)
def test_a_flange_that_swings_is_said_to_with_its_period(cell, period):
    swing = np.sin(2 * np.pi * np.arange(VIEWS) / period + 1.0)
    linear = linear_of(cell, swing[:, None] * DIRECTION)
    found = verdict_of(linear)
    assert found.verdict == "unknown_effect" and not found.named
    words = find_repeating_errors(linear)[0].words
    assert words.startswith("swing to and fro about every ")
    said = float(words.split()[6])
    # Two frequencies that fit half a swing more or less into the session are next to each other.
    assert abs(1 / said - 1 / period) < 0.5 / (VIEWS - 1)


def test_a_stretch_of_views_that_stands_off_is_said_to(cell):
    stretch = np.exp(-0.5 * ((np.arange(VIEWS) - 9) / 1.7) ** 2)
    linear = linear_of(cell, 2 * stretch[:, None] * DIRECTION)
    found = verdict_of(linear)
    assert found.verdict == "unknown_effect" and not found.named
    words = find_repeating_errors(linear)[0].words
    assert words.startswith("are off for a stretch of 3.5 views") and words.endswith(("v009", "v010", "v011"))


def test_a_long_stretch_is_told_in_place_of_what_wanders(cell):
    """What wanders can do what a long stretch does: beside it the stretch gains little, alone it explains more."""
    stretch = np.exp(-0.5 * ((np.arange(VIEWS) - 9) / 3.5) ** 2)
    linear = linear_of(cell, 1.5 * stretch[:, None] * DIRECTION)
    assert likeliest_time_effect(linear)[1] < ODDS
    fitted = significant_time_effect(linear)
    assert fitted.process.words.startswith("are off for a stretch")
    assert not set(DRIFT_MEMORY) & set(fitted.base.pose_errors.names)
    found = verdict_of(linear)
    assert found.verdict == "unknown_effect" and find_repeating_errors(linear)[0].curve is not None


def test_no_course_is_told_where_poses_wander(cell):
    for seed in range(2):
        wander = with_memory(VIEWS, 0.9, np.random.default_rng(seed)) * np.repeat([4e-5, 0.04], 3)
        assert significant_time_effect(linear_of(cell, wander)) is None


def test_scatter_follows_no_course_of_time(cell):
    linear = linear_of(cell, np.zeros((VIEWS, 6)))
    assert significant_time_effect(linear) is None and verdict_of(linear).verdict == "adequate"


def test_a_swing_is_as_likely_as_another_search_over_all_sizes_finds(cell):
    """Against the density of what the hand-eye leaves, by scipy, and Powell's search over every size at once."""
    swing = np.sin(2 * np.pi * np.arange(VIEWS) / 6.0)
    linear = linear_of(cell, swing[:, None] * DIRECTION)
    fitted, factor = likeliest_time_effect(linear)
    scales = linear.pose_errors.scales
    free = null_space(linear.mixed.A[0].T).T
    every = [free @ C @ free.T for C in linear.mixed.components[:, 0]]
    fixed = 0 if linear.mixed.fixed is None else free @ linear.mixed.fixed[0] @ free.T
    columns = free @ fitted.columns

    def likely(log_variances, size):
        covariance = np.tensordot(np.exp(log_variances), every, axes=1) + fixed + size**2 * columns @ columns.T
        density = multivariate_normal(cov=covariance, allow_singular=True).logpdf(free @ linear.mixed.z[0])
        return density - 0.5 * log_prior(log_variances, linear.mixed.further)[0]

    without = likely(np.log(linear.null.variances), 0.0)
    begun = np.log([*SCATTER**2, 1.0, *(1e-2 * scales**2), 3.0])
    search = minimize(lambda x: -likely(x[:-1], np.exp(x[-1])), begun, method="Powell", options={"ftol": 1e-6})
    assert -search.fun - without > 10
    assert fitted.log_bayes_factor == pytest.approx(-search.fun - without, abs=0.3)
    # Of all courses of all kinds it is one: their mean is no larger, and no less than its share.
    processes = time_processes(linear)
    share = 1 / (3 * sum(process.kind == fitted.process.kind for process in processes))
    assert fitted.log_bayes_factor + np.log(share) <= factor < fitted.log_bayes_factor


def test_a_break_of_weeks_leaves_few_courses_to_try(cell):
    """Two minutes from view to view, and a month between the first nine and the others."""
    linear = linear_of(cell, np.zeros((VIEWS, 6)))
    views = linear.measurement.views
    time = 120.0 * np.arange(VIEWS) + 30 * 86400.0 * (np.arange(VIEWS) >= 9)
    later = replace(linear, measurement=replace(linear.measurement, views=replace(views, time=time)))
    courses = time_processes(later)
    stretches = [course for course in courses if course.words.startswith("are off")]
    assert len({course.frequency for course in courses}) < 300 and stretches
    assert all(np.count_nonzero(course.shapes > 0.5) >= 2 for course in stretches)


def test_stretches_are_tried_all_over_a_session_without_breaks(cell):
    linear = linear_of(cell, np.zeros((VIEWS, 6)))
    views = linear.measurement.views
    even = replace(linear.measurement, views=replace(views, time=90.0 * np.arange(VIEWS)))
    middles = [course.shapes[:, 0] for course in time_processes(replace(linear, measurement=even))]
    width = [shape for shape in middles if np.isclose(shape.max(), 1, atol=0.1) and np.count_nonzero(shape > 0.5) < 5]
    assert len(width) == len(np.arange(1.5, 17 - 0.75, 1.5))
