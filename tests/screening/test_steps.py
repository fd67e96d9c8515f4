"""Change points in the order of time, against a generator of chance whose every size is known, and in whole runs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.observations.pose_errors import PoseErrors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.output.comparison.model_history import model_history
from stitch.output.comparison.run_verdict import run_verdict
from stitch.screening import pose_tests
from stitch.screening.pose_tests import PoseTests, expected_poses, find_blunders, find_steps
from stitch.session.session import Cloud
from tests.screening.direct_views import direct_views, with_z

VIEWS, SIGMA, MEMORY = 18, 0.02, 20.0
STEP = SIGMA * np.array([0.5, -1, 0.3, 1, 0.2, -0.7])


def direct(seed, wanders=0.0):
    """Every pose is observed directly, about one common one; beside white scatter it may wander."""
    rng, time = np.random.default_rng(seed), np.arange(VIEWS)
    alike = np.kron(np.exp(-np.abs(time[:, None] - time) / MEMORY), np.eye(6))
    z = SIGMA * rng.standard_normal(6 * VIEWS) + wanders * np.linalg.cholesky(alike) @ rng.standard_normal(6 * VIEWS)
    return direct_views(z, errors=PoseErrors(("wandering",), SIGMA**2 * alike[None], np.ones(1)))


def steps(model):
    return find_steps(model, None, (None, 0), 0.01)


def stepped(model, *starts, times=30.0):
    moved = sum(times * (-1) ** i * np.outer(np.arange(VIEWS) >= k, STEP) for i, k in enumerate(starts))
    return with_z(model, model.z + moved.ravel())


@pytest.mark.parametrize("start", [2, 9, 16])
def test_a_common_displacement_is_found_where_it_begins_with_its_size(start):
    (found,) = steps(stepped(direct(5), start))
    assert found.start == start and found.p_value < 1e-6
    assert found.size[1] == pytest.approx(30 * np.linalg.norm(STEP[3:]), rel=0.1)
    assert found.size[0] == pytest.approx(30 * np.linalg.norm(STEP[:3]), rel=0.1)


def test_part_and_scanner_that_look_alike_are_not_told_apart():
    (found,) = steps(stepped(direct(5), 9))
    assert not found.distinguishable and "these views do not show which" in found.describe(
        [f"v{k}" for k in range(VIEWS)], "mm"
    )


def test_what_is_moved_there_and_back_is_two_steps():
    assert [s.start for s in steps(stepped(direct(6), 6, 12))] == [6, 12]


def test_what_drifts_is_no_step():
    model = direct(7)
    drift = np.linspace(0, 30, VIEWS)[:, None] * STEP
    assert steps(with_z(model, model.z + drift.ravel())) == ()


def test_one_view_at_the_end_that_is_off_is_a_blunder_and_no_step():
    model = stepped(direct(8), VIEWS - 1, times=100.0)
    singles = find_blunders(replace(model, errors=None))
    assert [b.view for b in singles.blunders] == [VIEWS - 1]
    assert find_steps(model, None, (singles.mean_columns, 1), 0.01) == ()


def off(model, view, times=100.0):
    return with_z(model, model.z + times * np.kron(np.arange(VIEWS) == view, STEP))


def test_one_view_in_the_middle_that_is_off_is_no_two_steps():
    assert steps(off(direct(9), 9)) == ()


def test_a_step_is_found_beside_a_view_farther_off():
    (found,) = steps(off(stepped(direct(10), 9), 4))
    assert found.start == 9
    assert found.size[1] == pytest.approx(30 * np.linalg.norm(STEP[3:]), rel=0.1)


def test_half_of_the_views_let_go_explain_a_step_no_better_than_the_step():
    model = stepped(direct(11), 9)
    (found,) = find_steps(model, None, (model.columns(range(9, VIEWS)), 9), 0.01)
    assert found.start == 9


def test_where_every_view_stands_free_no_step_is_sought():
    """Left out and let go until nothing was left to be tested: the search ended in an error."""
    assert find_steps(direct(10), direct(10).columns(range(VIEWS - 1)), (None, 0), 0.01) == ()


def test_of_six_views_every_start_of_a_step_may_be_taken():
    """What is likeliest then is a single view: the search ended in an error."""
    z = SIGMA * np.random.default_rng(0).standard_normal(36)
    model = direct_views(z, errors=PoseErrors(("white",), SIGMA**2 * np.eye(36)[None], np.ones(1)))
    pick = pose_tests._next_pick(model, None, [dict.fromkeys(pose_tests.MOVED_BODIES, k) for k in (2, 3, 4)])
    assert pick is not None and pick.starts is None
    assert pick.columns.shape == (36, 6) and pick.tests == 6


def test_what_a_view_is_off_by_beside_a_step_is_its_own():
    model = off(stepped(direct(12), 9), 4, times=50.0)
    tests = PoseTests([], [], find_blunders(replace(model, errors=None), [4], steps(model)), steps(model))
    tests = replace(tests, unplaced=[4])
    freed = UnconstrainedPoses(np.empty((VIEWS, 4, 4)), model.z.reshape(VIEWS, 6), None)
    expected = frames.log(expected_poses(replace(model, errors=None), np.tile(np.eye(4), (VIEWS, 1, 1)), freed, tests))
    own = freed.twists - expected
    np.testing.assert_allclose(own[4], 50 * STEP, atol=0.1)
    assert np.abs(np.delete(own, 4, axis=0)).max() < 5 * SIGMA


@pytest.mark.slow
@pytest.mark.parametrize("wanders", [0.0, 3 * SIGMA])
def test_sessions_without_a_step_raise_no_more_alarms_than_stated(wanders):
    """1 % is stated, and change points are counted as if they were independent: what 999 of 1,000 repetitions stay at."""
    alarms = sum(bool(steps(direct(100 + seed, wanders))) for seed in range(60))
    assert alarms <= stats.binom.isf(1e-3, 60, 0.01)


@pytest.fixture(scope="module")
def good():
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
def test_a_knock_of_the_scanner_is_said_in_the_first_line(good):
    """4.5 mm half way: every view fits its neighbours once it is moved, and one hand-eye holds for neither half."""
    found = run(knocked(good, 6, [0, 0, 0, 2.7, 0, 3.6]))
    said = run_verdict(found, model_history(found))
    assert found.left_out == () and len(found.doubts) == 1
    assert said.startswith("From view v006 on the scanner sits elsewhere, at least 4.")
    assert "one up to v005 and one from v006 on" in said
