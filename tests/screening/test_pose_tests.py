"""Tests of poses against closed forms and a generator of chance whose every size is known, and in whole runs.

A base that moved is told from an arm that is bad.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.quiet_scenes import simulated, with_part
from data_synth.scene import load_scene
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.numerics.reml import at_variances
from stitch.observations.pose_errors import PoseErrors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.output.comparison.model_history import model_history
from stitch.output.comparison.run_verdict import run_verdict
from stitch.screening import pose_tests
from stitch.screening.common_move import find_common_move
from stitch.screening.deep_check import deep_check
from stitch.screening.pose_tests import (
    expected_poses,
    find_blunders,
    find_steps,
    least_displacement,
    length_problem,
)
from stitch.screening.view_model import projector, test_alternative
from stitch.session.capture import prepare_capture
from stitch.session.session import Cloud
from tests.observations.honest_arms import WORLDS, bad_arm
from tests.screening.direct_views import direct_views, with_z

test_alternative.__test__ = False  # a function of the library, not a case
VIEWS, SIGMA, OFF = 20, 0.02, 7
STEP_VIEWS, MEMORY = 18, 20.0
STEP = SIGMA * np.array([0.5, -1, 0.3, 1, 0.2, -0.7])
# Of the poses, rad and in units of their spread.
TURN, SHIFT = 1e-3, 0.02
DRAWS, STATED = 100, 1e-4


def observed(seed=0, views=VIEWS):
    return direct_views(SIGMA * np.random.default_rng(seed).standard_normal(6 * views))


def known(model):
    """The null hypothesis with the scatter that was put in."""
    fit = at_variances(model.mixed(), np.array([SIGMA**2, SIGMA**2, 1.0]))
    return fit, projector(model, fit)


def test_statistic_is_the_drop_of_least_squares():
    model = observed()
    _, under = known(model)
    whitened = model.z / SIGMA
    null = whitened - model.hand_eye @ np.linalg.lstsq(model.hand_eye, whitened, rcond=None)[0]
    both = np.column_stack([model.hand_eye, model.views[3]])
    free = whitened - both @ np.linalg.lstsq(both, whitened, rcond=None)[0]
    assert test_alternative(under, model.views[3]).statistic == pytest.approx(null @ null - free @ free, rel=1e-4)


@pytest.mark.slow
def test_good_views_stay_and_several_blunders_do_not_hide_each_other():
    false = sum(bool(find_blunders(observed(seed)).blunders) for seed in range(20))
    assert false <= 2  # at 1 % each, three of twenty happen once in a thousand
    model = observed(3)
    z = np.array(model.z)
    for v in (2, 7, 11):
        z[6 * v + 3] += 40 * SIGMA
    found = find_blunders(with_z(model, z))
    assert set(found.blunders) == {2, 7, 11}
    assert np.sqrt(found.fit.variances[1]) < 1.5 * SIGMA


def test_one_of_six_views_does_not_hide_in_a_scatter_that_it_inflates():
    """Rotations scatter little, and one view is off by ten times that of the translations."""
    quiet = np.tile([1e-3, 1e-3, 1e-3, 1, 1, 1], 6)
    for seed in range(10):
        model = observed(seed, views=6)
        z = model.z * quiet + model.views[2] @ np.array([0, 0, 0, 10 * SIGMA, 0, 0])
        assert find_blunders(with_z(model, z)).blunders == (2,)


@pytest.mark.slow
def test_few_views_without_blunders_are_left_alone():
    """1 % is stated: what 999 of 1,000 repetitions stay below."""
    quiet, alarms = np.tile([1e-3, 1e-3, 1e-3, 1, 1, 1], 6), 0
    for seed in range(200):
        model = observed(1000 + seed, views=6)
        alarms += bool(find_blunders(with_z(model, model.z * (quiet if seed % 2 else 1))).blunders)
    assert alarms <= stats.binom.isf(1e-3, 200, 0.01)


def partly_shown(shown, blunder, seed=0):
    """All poses observed directly, the mean of all the unknown hand-eye; of one view each direction is shown by a share."""
    reduction = np.eye(6 * VIEWS)
    reduction[6 * OFF : 6 * OFF + 6, 6 * OFF : 6 * OFF + 6] = np.diag(np.sqrt(shown))
    moved = reduction[:, 6 * OFF : 6 * OFF + 6] @ blunder
    return direct_views(SIGMA * np.random.default_rng(seed).standard_normal(6 * VIEWS) + moved, reduction)


def least_of_one(model):
    fit = at_variances(model.mixed(), np.array([SIGMA**2, SIGMA**2, 1.0]))
    return least_displacement(model, replace(find_blunders(model), fit=fit, blunders=()), OFF, np.zeros(3))


def test_what_every_direction_shows_is_shorter_by_the_radius_of_its_confidence():
    rotation, shift = least_of_one(partly_shown(np.ones(6), np.array([0, 0, 0, 3.0, 0, 4.0])))
    radius = SIGMA * np.sqrt(6 * stats.f.isf(0.01, 6, 6 * VIEWS - 12) / (1 - 1 / VIEWS))
    assert shift == pytest.approx(5.0 - radius, abs=3 * SIGMA) and rotation < 3 * SIGMA


def test_less_than_chance_makes_is_none():
    assert least_of_one(partly_shown(np.ones(6), np.zeros(6))) == (0.0, 0.0)


def test_a_direction_in_which_nothing_holds_the_view_has_no_size():
    """A thousandth of it is seen: what noise makes of that would be thirty times as much."""
    shown = np.array([1, 1, 1, 1e-3, 1, 1])
    rotation, shift = least_of_one(partly_shown(shown, np.array([0, 0, 0, 30.0, 0, 1.0])))
    assert shift < 1.0 and rotation < 3 * SIGMA


@pytest.mark.slow
def test_scans_that_slide_along_a_plate_cost_no_view_beside_backlash():
    """All slid about the plate's axis by 4 mrad and more, and five of the views that backlash displaces were left out."""
    scene = load_scene("blade-table")
    scene = replace(scene, scanner=replace(scene.scanner, columns=120, rows=120))
    plate = with_part(scene, "curved_drill_plate", length=150.0, width=120.0, pitch=36.0, radius=150.0)
    assert run(session_of(simulated(plate, {"backlash": 3.0}, 9042, 14))).left_out == ()


@pytest.mark.slow
def test_views_behind_a_step_are_not_called_displaced_where_the_part_looks_alike():
    """From half way on a plate sits 3 mm elsewhere; three right scans of its other side were called 120° off."""
    scene = load_scene("blade-table")
    scene = replace(scene, scanner=replace(scene.scanner, columns=120, rows=120))
    plate = with_part(scene, "curved_drill_plate", length=150.0, width=120.0, pitch=36.0, radius=150.0)
    session, views = session_of(simulated(plate, {}, 9086, 12)), []
    rng = np.random.default_rng([9086, 11])
    turn, shift = rng.standard_normal((2, 3))
    K = frames.exp(np.r_[6e-3 * turn / np.linalg.norm(turn), 3 * shift / np.linalg.norm(shift)])
    for v, view in enumerate(session.views):
        T = view.T_base_flange if v < 6 else K @ view.T_base_flange
        views.append(replace(view, T_base_flange=T, joints=None))
    gone = run(replace(session, views=tuple(views))).left_out
    assert gone and all("clamped anew between v005 and v006" in item.why for item in gone)


def wandering(seed, wanders=0.0):
    """Every pose is observed directly, about one common one; beside white scatter it may wander."""
    rng, time = np.random.default_rng(seed), np.arange(STEP_VIEWS)
    alike = np.kron(np.exp(-np.abs(time[:, None] - time) / MEMORY), np.eye(6))
    z = SIGMA * rng.standard_normal(6 * STEP_VIEWS) + wanders * np.linalg.cholesky(alike) @ rng.standard_normal(
        6 * STEP_VIEWS
    )
    return direct_views(z, errors=PoseErrors(("wandering",), SIGMA**2 * alike[None], np.ones(1)))


def steps(model):
    return find_steps(model, None, None, 0.01)


def stepped(model, *starts, times=30.0):
    moved = sum(times * (-1) ** i * np.outer(np.arange(STEP_VIEWS) >= k, STEP) for i, k in enumerate(starts))
    return with_z(model, model.z + moved.ravel())


@pytest.mark.parametrize("start", [2, 9, 16])
def test_a_common_displacement_is_found_where_it_begins_with_its_size(start):
    (found,) = steps(stepped(wandering(5), start))
    assert found.start == start and found.p_value < 1e-6
    assert found.size[1] == pytest.approx(30 * np.linalg.norm(STEP[3:]), rel=0.1)
    assert found.size[0] == pytest.approx(30 * np.linalg.norm(STEP[:3]), rel=0.1)


def test_part_and_scanner_that_look_alike_are_not_told_apart():
    (found,) = steps(stepped(wandering(5), 9))
    assert not found.distinguishable and "these views do not show which" in found.describe(
        [f"v{k}" for k in range(STEP_VIEWS)], "mm"
    )


def test_what_is_moved_there_and_back_is_two_steps():
    assert [s.start for s in steps(stepped(wandering(6), 6, 12))] == [6, 12]


def test_what_drifts_is_no_step():
    model = wandering(7)
    drift = np.linspace(0, 30, STEP_VIEWS)[:, None] * STEP
    assert steps(with_z(model, model.z + drift.ravel())) == ()


def test_one_view_at_the_end_that_is_off_is_a_blunder_and_no_step():
    model = stepped(wandering(8), STEP_VIEWS - 1, times=100.0)
    singles = find_blunders(replace(model, errors=None))
    assert singles.blunders == (STEP_VIEWS - 1,)
    assert find_steps(model, None, singles.mean_columns, 0.01) == ()


def with_one_off(model, view, times=100.0):
    return with_z(model, model.z + times * np.kron(np.arange(STEP_VIEWS) == view, STEP))


def test_one_view_in_the_middle_that_is_off_is_no_two_steps():
    assert steps(with_one_off(wandering(9), 9)) == ()


def test_a_step_is_found_beside_a_view_farther_off():
    (found,) = steps(with_one_off(stepped(wandering(10), 9), 4))
    assert found.start == 9
    assert found.size[1] == pytest.approx(30 * np.linalg.norm(STEP[3:]), rel=0.1)


def test_half_of_the_views_let_go_explain_a_step_no_better_than_the_step():
    model = stepped(wandering(11), 9)
    (found,) = find_steps(model, None, model.columns(range(9, STEP_VIEWS)), 0.01)
    assert found.start == 9


def test_where_every_view_stands_free_no_step_is_sought():
    """Left out and let go until nothing was left to be tested: the search ended in an error."""
    assert find_steps(wandering(10), wandering(10).columns(range(STEP_VIEWS - 1)), None, 0.01) == ()


def test_of_six_views_every_start_of_a_step_may_be_taken():
    """What is likeliest then is a single view: the search ended in an error."""
    z = SIGMA * np.random.default_rng(0).standard_normal(36)
    model = direct_views(z, errors=PoseErrors(("white",), SIGMA**2 * np.eye(36)[None], np.ones(1)))
    pick = pose_tests._next_pick(model, None, {2, 3, 4})
    assert pick is not None and pick.starts is None
    assert pick.columns.shape == (36, 6) and pick.tests == 6


def test_what_a_view_is_off_by_beside_a_step_is_its_own():
    model = with_one_off(stepped(wandering(12), 9), 4, times=50.0)
    search = find_blunders(replace(model, errors=None), [4], steps(model))
    tests = replace(search, unplaced=[4], steps=steps(model))
    freed = UnconstrainedPoses(np.empty((STEP_VIEWS, 4, 4)), model.z.reshape(STEP_VIEWS, 6), None)
    expected = frames.log(
        expected_poses(replace(model, errors=None), np.tile(np.eye(4), (STEP_VIEWS, 1, 1)), freed, tests)
    )
    own = freed.twists - expected
    np.testing.assert_allclose(own[4], 50 * STEP, atol=0.1)
    assert np.abs(np.delete(own, 4, axis=0)).max() < 5 * SIGMA


@pytest.mark.slow
@pytest.mark.parametrize("wanders", [0.0, 3 * SIGMA])
def test_sessions_without_a_step_raise_no_more_alarms_than_stated(wanders):
    """1 % is stated, and change points are counted as if they were independent: what 999 of 1,000 repetitions stay at."""
    alarms = sum(bool(steps(wandering(100 + seed, wanders))) for seed in range(60))
    assert alarms <= stats.binom.isf(1e-3, 60, 0.01)


@pytest.fixture(scope="module")
def good_blade():
    return session_of(measured_blade(21, views=12, pixels=80))


def knocked(session, start, xi):
    """From view `start` on the scanner sits at M·exp(ξ): it reports exp(−ξ)·x."""
    back = frames.exp(-np.asarray(xi, float))
    views = [
        replace(v, cloud=Cloud(frames.transform(back, v.cloud.points))) if k >= start else v
        for k, v in enumerate(session.views)
    ]
    return replace(session, views=tuple(views))


@pytest.mark.slow
def test_a_knock_of_the_scanner_is_said_in_the_first_line(good_blade):
    """4.5 mm half way: every view fits its neighbours once it is moved, and one hand-eye holds for neither half."""
    found = run(knocked(good_blade, 6, [0, 0, 0, 2.7, 0, 3.6]))
    said = run_verdict(found, model_history(found))
    assert found.left_out == () and len(found.doubts) == 1
    assert said.startswith("From view v006 on the scanner sits elsewhere, at least 4.")
    assert "one up to v005 and one from v006 on" in said


def seen_views(seed, views, factor=1.0, scatter=1.0, displaced=0.0):
    """Views that overlaps show but for a motion of them all, and their poses; scans `factor` times as large.

    Args:
        displaced: how many times as far as poses scatter view 1 stands off.
    """
    rng = np.random.default_rng([views, seed])
    T = frames.make(Rotation.random(views, rng=rng).as_matrix(), rng.normal(size=(views, 3)))
    twists = rng.standard_normal((views, 6)) * np.repeat([TURN, SHIFT], 3) * scatter
    twists[1] += rng.standard_normal(6) * np.repeat([TURN, SHIFT], 3) * displaced
    twists[:, 3:] += (factor - 1) * T[:, :3, 3]
    seen, mounts = null_space(np.tile(np.eye(6), views)).T, frames.adjoint(T)
    model = direct_views(np.zeros(6 * views), seen)
    reduced = replace(
        model.reduced,
        z=seen @ twists.ravel(),
        hand_eye=seen @ mounts.reshape(-1, 6),
    )
    return replace(model, reduced=reduced, mount_jacobians=mounts), T


@pytest.mark.parametrize("views", [3, 4])
def test_few_poses_show_no_factor_by_chance(views):
    """What 999 of 1,000 repetitions stay below."""
    alarms = sum(length_problem(*seen_views(seed, views)) is not None for seed in range(DRAWS))
    assert alarms <= stats.binom.isf(1e-3, DRAWS, STATED)


def test_a_factor_is_named_with_its_size():
    said = length_problem(*seen_views(0, 4, 1.1, scatter=1e-3)).fix
    assert float(said.split("clouds are ")[1].split()[0]) == pytest.approx(1.1, abs=4e-3 * SHIFT)


def test_a_factor_stands_in_the_place_of_a_view_that_took_it_upon_itself():
    """Of four views the other three fit any factor."""
    for seed in range(5):
        model, T = seen_views(seed, 4, 10.0)
        assert "clouds are 10 times as large" in length_problem(model, T, model.columns([1])).fix


def test_a_view_that_is_off_is_no_factor():
    for seed in range(5):
        model, T = seen_views(seed, 4, displaced=200)
        assert length_problem(model, T, model.columns([1])) is None


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("seed", [40, pytest.param(41, marks=pytest.mark.slow)])
def test_a_bad_arm_is_neither_refused_nor_said_to_have_moved(world, seed):
    assert deep_check(bad_arm(world, 0.0, seed)[0]) == []


@pytest.mark.parametrize("world", WORLDS)
def test_a_move_of_eight_times_its_error_is_named_with_the_view(world):
    session, start = bad_arm(world, 8.0, 42)
    (found,) = deep_check(session)
    assert found.kind == "reclamped" and abs(int(found.views[0][1:]) - start) <= 1


@pytest.mark.parametrize(("by", "sure"), [(0.3, True), (0.06, False)])
def test_a_move_of_the_arms_own_size_is_a_doubt(by, sure):
    session, *_ = labelled_cell(3, views=60, mount="eye_in_hand")
    views = list(session.views)
    for v in range(25, 60):
        T = np.array(views[v].T_base_flange)
        T[:3, 3] += [by, 0, 0]
        views[v] = replace(views[v], T_base_flange=T, joints=None)
    move = find_common_move(prepare_capture(replace(session, views=tuple(views))))
    assert move is not None and abs(move.start - 25) <= 1
    assert move.is_sure == sure and move.moved == pytest.approx(by, abs=0.04)


def test_of_few_views_no_move_is_asked():
    assert find_common_move(prepare_capture(labelled_cell(3, views=7)[0])) is None
