"""What a flange does in time by no law of the library, and errors without a name as rivals of names."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from data_synth.arms import ARMS
from data_synth.fixtures.labelled_arm import TARGETS, flange, joints_of, labelled_cell
from data_synth.laws.unnamed import UNNAMED
from data_synth.moment import Plan
from data_synth.ordinary_arm import with_memory
from stitch.api.pipeline import diagnose, run
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.sentences import time_curve_sentence
from stitch.diagnosis.thresholds import IMPLAUSIBLE, ODDS
from stitch.diagnosis.unmodelled_time_effects import (
    TimeCurve,
    find_repeating_errors,
    least_log_bayes_factor,
    likeliest_time_effect,
    significant_time_effect,
    time_curve,
    time_processes,
    unmodelled_trends,
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


def test_no_time_effect_is_told_where_poses_wander(cell):
    for seed in range(2):
        wander = with_memory(VIEWS, 0.9, np.random.default_rng(seed)) * np.repeat([4e-5, 0.04], 3)
        assert significant_time_effect(linear_of(cell, wander)) is None


def test_scatter_follows_no_trend_in_time(cell):
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


def test_a_break_of_weeks_leaves_few_time_effects_to_try(cell):
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


@pytest.fixture(scope="module", params=["eye_to_hand", pytest.param("eye_in_hand", marks=pytest.mark.slow)])
def mounted_cell(request):
    return freed_blade(5, VIEWS, request.param)


def shown(mounted_cell, course, direction):
    """The curve found where the flange errs along a direction (6,), and by how many sigmas it is off at the views that
    err, (·, 6)."""
    errors = course[:, None] * direction
    linear = mounted_cell.seen(mounted_cell.measured.T_base_flange @ frames.exp(errors))
    fitted = significant_time_effect(linear)
    assert fitted is not None
    curve = time_curve(fitted)
    at_views = slice(None, None, (len(curve.steps) - 1) // (VIEWS - 1))
    off = (curve.error[at_views] - errors) / np.maximum(curve.sigma[at_views], 1e-300)
    return curve, off[np.abs(course) > 0.2]


def in_steps(mounted_cell):
    """Times of the views in median steps, by numpy alone."""
    time = mounted_cell.measurement.views.time
    return (time - time[0]) / np.median(np.diff(time))


@pytest.mark.parametrize("period", [4.3, 7.1])
def test_a_swing_is_drawn_as_it_was(mounted_cell, period):
    curve, off = shown(mounted_cell, np.sin(2 * np.pi * in_steps(mounted_cell) / period + 1.0), DIRECTION)
    assert np.sqrt(np.mean(off**2)) < 2.0
    for of in (slice(3), slice(3, 6)):
        _, most, sigma = curve.largest(of)
        assert abs(most - np.linalg.norm(DIRECTION[of])) < 4 * sigma


def test_a_stretch_is_drawn_where_it_was(mounted_cell):
    time = in_steps(mounted_cell)
    curve, off = shown(mounted_cell, np.exp(-0.5 * ((time - time[9]) / 1.5) ** 2), 2 * DIRECTION)
    assert np.sqrt(np.mean(off**2)) < 2.0
    assert curve.steps[curve.largest(slice(3, 6))[0]] == pytest.approx(time[9], abs=1.0)


def test_a_time_curve_reads_with_its_sizes_and_places():
    error, sigma = np.zeros((3, 6)), np.full((3, 6), 1e-5)
    error[1, :3], error[2, 3:], sigma[:, 3:] = (0, 3e-4, 4e-4), (0.06, -0.08, 0), 0.01
    curve = TimeCurve(np.array([2.0, 4.0, 6.0]), 90.0, error, sigma)
    assert "0.1 ± 0.01 mm 6 min into the session, and turned by up to 0.5 ± 0.01 mrad 3 min" in time_curve_sentence(
        curve, "mm"
    )
    by_number = TimeCurve(curve.steps, 0.0, error, sigma)
    assert "mm at view 4, and turned by up to 0.5 ± 0.01 mrad at view 2" in time_curve_sentence(by_number, "mm")


MANY, SEED = 120, 31


def law_of(name: str) -> np.ndarray:
    """(V, 6) rad, three times as large as a good arm's."""
    joints = joints_of(np.random.default_rng(SEED), MANY)
    plan = Plan(joints, 0 * joints, 0 * joints, next(iter(ARMS.values())), useful=tuple(range(6)))
    return 3 * UNNAMED[name](plan, np.random.default_rng([SEED, 1]))


def memory() -> np.ndarray:
    """(V, 6) rad and mm of a flange: AR(1), 0.9, of 120 µm and 0.12 mrad."""
    return with_memory(MANY, 0.9, np.random.default_rng([SEED, 2])) * np.repeat([1.2e-4, 0.12], 3)


@pytest.mark.parametrize(
    "which", [*(pytest.param(law_of, marks=pytest.mark.slow) for law_of in ("hysteresis", "dress_pack")), "memory"]
)
def test_errors_that_no_library_has_get_no_name(which):
    nothing = np.zeros((MANY, 6))
    errors = (nothing, memory()) if which == "memory" else (law_of(which), nothing)
    session, *_ = labelled_cell(SEED, views=MANY, errors=errors, targets=TARGETS[:2])
    found = diagnose(run(session))
    assert found.verdict == "unknown_effect", found.sentence
    if which == "memory":
        assert [u.words for u in found.repeating_errors] == ["wander in time"]
    else:
        joint = 1 + int(np.abs(errors[0]).sum(axis=0).argmax())
        assert [u.words for u in found.repeating_errors] == [f"follow the joints, joint {joint} above all"]


@pytest.mark.usefixtures("few_effects")
def test_an_eccentric_gear_and_a_curve_of_its_joint_without_a_name_are_rivals():
    """Within 70° of its middle a wave once a turn is any smooth curve, where it is as small as this."""
    gear = 1.2e-4 * np.eye(6)[2]
    session, *_ = labelled_cell(SEED, views=MANY, gears=lambda q: gear * np.sin(q), targets=TARGETS[:2])
    found = diagnose(run(session))
    assert (found.verdict, found.effects) == ("cannot_tell", ("gear_eccentricity",)), found.sentence
    assert "gear_eccentricity or joint 3 follows a smooth curve without a name" in found.sentence
    assert found.candidates[0].cross_validation.helps


@pytest.mark.slow
def test_joints_that_scatter_do_not_repeat():
    """Every joint anew at every pose, 40 µrad beside a steady flange: scatter, and as large as it was drawn."""
    for seed in range(4):
        off = 4e-5 * np.random.default_rng([SEED, seed]).standard_normal((40, 6))
        session, *_ = labelled_cell(SEED + seed, views=40, scatter=(1e-5, 0.01), errors=(off, np.zeros((40, 6))))
        found = diagnose(run(session))
        assert found.verdict == "adequate", found.sentence
        joints = joints_of(np.random.default_rng(SEED + seed), 40)
        moved = np.array([flange(q + e)[:3, 3] - flange(q)[:3, 3] for q, e in zip(joints, off, strict=True)])
        drawn = np.sqrt((moved**2).mean() + 0.01**2)
        assert found.translation == pytest.approx(drawn, rel=0.35)


@pytest.mark.usefixtures("few_effects")
def test_scatter_beside_an_unmodelled_effect_is_what_the_arm_scatters():
    """20 µm are drawn, and the law does not take them for itself; of what it turns most is no scatter any more."""
    session, *_ = labelled_cell(SEED, views=MANY, errors=(law_of("coupling"), np.zeros((MANY, 6))))
    found = diagnose(run(session))
    assert found.repeating_errors and found.translation == pytest.approx(0.02, rel=0.25), found.sentence
    assert found.rotation**2 < 0.5 * found.linear.null.variances[0]


def test_an_effect_that_is_there_is_wanted_beside_them_one_that_is_not_is_idle():
    """Beside a joint without a name that errs too: what is left of the evidence for the offset still names it."""
    errors = (law_of("dress_pack"), np.zeros((MANY, 6)))
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = labelled_cell(SEED, views=MANY, offset=offset, errors=errors, targets=TARGETS[:2])
    found = diagnose(run(session))
    assert found.effects == ("joint_offset",), found.sentence
    scored = found.candidates[0].ranked.score
    assert found.candidates[0].name == "joint_offset" and least_log_bayes_factor(found.linear, scored)[0] > 20
    beside = found.linear.conditioned_on(scored.form.columns, scored.sizes)
    idle = next(c.ranked.score for c in found.candidates if c.name == "gear_harmonic")
    assert least_log_bayes_factor(beside, idle)[0] < 3
    # The law that is there is seen: a process explains it, with less scatter than the views seemed to have.
    likeliest = unmodelled_trends(beside)[0]
    assert 0.5 * (beside.null.deviance - likeliest.fit.deviance) > 20
    assert likeliest.fit.variances[0] < beside.null.variances[0]
