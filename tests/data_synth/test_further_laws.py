"""Laws of the second blind test: sizes, shapes, that each is drawn anew for every arm, and what marks its kind."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth import kinematics
from data_synth.arms import ARMS, with_payload
from data_synth.foreign_laws import FOREIGN
from data_synth.further_laws import FURTHER, FURTHER_IN_TIME, FURTHER_OF_FLANGE
from data_synth.moment import Plan
from data_synth.unnamed_laws import UNNAMED

SIZE, SHIFT = 1.5e-4, 0.05
VIEWS, SEEDS = 40, range(8)
OF_JOINTS = [law for law in FURTHER if law not in FURTHER_OF_FLANGE]


def plan_of(name: str, *, masses: bool = True, useful: tuple[int, ...] = (), views: int = VIEWS) -> Plan:
    """Views all over the middle half of what the joints can do."""
    arm = with_payload(ARMS[name], 3.0, (10.0, 0.0, 80.0))
    span = 0.25 * (arm.upper - arm.lower)
    q = (arm.lower + arm.upper) / 2 + span * np.random.default_rng(5).uniform(-1, 1, (views, arm.joints))
    torque = kinematics.gravity_torques(arm, q) if masses else 0 * q
    return Plan(q, torque, 0 * q, arm, useful or tuple(range(arm.joints)))


def drawn(law: str, plan: Plan, seed: int, **time: np.ndarray) -> np.ndarray:
    """Errors of one arm."""
    return FURTHER[law](plan, np.random.default_rng(seed), **time)


def relative(law: str, error: np.ndarray) -> float:
    """rms over the usual one; of a flange the larger of turn and shift."""
    if law not in FURTHER_OF_FLANGE:
        return float(np.sqrt((error**2).sum(axis=1).mean())) / SIZE
    return float((np.sqrt((error.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0)) / [SIZE, SHIFT]).max())


def test_they_are_eight_and_none_has_the_name_of_a_law_before():
    assert len(FURTHER) == 8 and not set(FURTHER) & {*UNNAMED, *FOREIGN}
    assert set(FURTHER_IN_TIME) <= set(FURTHER_OF_FLANGE) <= set(FURTHER)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("law", FURTHER)
def test_errors_are_of_a_good_arms_size_and_differ_from_view_to_view(law, arm):
    plan = plan_of(arm)
    for seed in SEEDS:
        error = drawn(law, plan, seed)
        assert error.shape == (VIEWS, 6 if law in FURTHER_OF_FLANGE else plan.arm.joints) and np.isfinite(error).all()
        assert 0.5 < relative(law, error) < 2
        assert error.std(axis=0).max() > 0


@pytest.mark.parametrize("law", FURTHER)
def test_a_seed_says_which_arm_it_is(law):
    plan = plan_of("KUKA KR30-3")
    arms = [drawn(law, plan, seed) for seed in SEEDS]
    assert np.array_equal(arms[0], drawn(law, plan, 0))
    assert all(np.abs(arms[0] - other).max() > 0 for other in arms[1:])


@pytest.mark.parametrize("law", FURTHER)
@pytest.mark.parametrize("useful", [(0,), (3,), (5,)])
def test_neither_masses_nor_many_useful_joints_are_needed(law, useful):
    plan = plan_of("UR10", masses=False, useful=useful)
    error = drawn(law, plan, 1)
    assert np.isfinite(error).all() and error.std(axis=0).max() > 0
    if law in OF_JOINTS and law != "ring_bolts":
        assert set(np.flatnonzero(np.ptp(error, axis=0))) == set(useful)


@pytest.mark.parametrize("law", FURTHER)
def test_arms_that_hardly_move_err_by_no_more(law):
    """One pose for all views, one joint that moves, and a single view."""
    plan = plan_of("KUKA LBR iiwa 14")
    still = replace(plan, joints=np.tile(plan.joints[:1], (VIEWS, 1)), torque=np.tile(plan.torque[:1], (VIEWS, 1)))
    turning = replace(still, joints=still.joints + np.outer(np.linspace(-1, 1, VIEWS), np.eye(7)[0]))
    for few in (still, turning, plan_of("KUKA LBR iiwa 14", views=1)):
        for seed in SEEDS:
            error = drawn(law, few, seed)
            assert np.isfinite(error).all() and relative(law, error) < 2


def test_what_follows_time_follows_it_and_not_the_joints():
    one, other = plan_of("UR10"), plan_of("KUKA KR30-3")
    for law in FURTHER_IN_TIME:
        assert np.array_equal(drawn(law, one, 2), drawn(law, other, 2))
    pauses = np.cumsum(np.linspace(0.2, 4.0, VIEWS))
    for law in (*FURTHER_IN_TIME, "slipping_bush"):
        late = drawn(law, one, 2, time=pauses)
        assert np.isfinite(late).all() and not np.array_equal(late, drawn(law, one, 2))
        assert np.allclose(late, drawn(law, one, 2, time=pauses + 100.0))


def test_an_eccentric_wheel_errs_two_neighbours_alike():
    error = drawn("differential_wheel", plan_of("KUKA KR30-3"), 3)
    i, k = np.flatnonzero(np.ptp(error, axis=0))
    assert k == i + 1 and np.array_equal(np.abs(error[:, i]), np.abs(error[:, k]))


def test_a_bush_turns_its_wave_once():
    """Before and after it slips one sine of the joint is left, over the whole session none."""
    plan = plan_of("KUKA KR30-3")
    error = drawn("slipping_bush", plan, 4)
    (i,) = np.flatnonzero(np.ptp(error, axis=0))
    basis = np.column_stack([np.ones(VIEWS), np.sin(plan.joints[:, i]), np.cos(plan.joints[:, i])])

    def left(views: slice) -> float:
        fit = np.linalg.lstsq(basis[views], error[views, i], rcond=None)[0]
        return float(np.abs(error[views, i] - basis[views] @ fit).max())

    at = [max(left(slice(v)), left(slice(v, None))) for v in range(5, VIEWS - 5)]
    assert min(at) < 1e-12 and left(slice(None)) > 0.2 * SIZE


def test_tubes_sag_towards_the_floor_and_tip_about_a_level_axis():
    plan = plan_of("KUKA KR30-3")
    error = drawn("bending_tubes", plan, 3)
    frames = kinematics.links(plan.arm, plan.joints)
    turn, shift = (np.einsum("vij,vj->vi", frames[:, -1, :3, :3], x) for x in (error[:, :3], error[:, 3:]))
    assert np.abs(turn[:, 2]).max() < 1e-12 and np.abs(shift[:, :2]).max() < 1e-12
    reach = np.linalg.norm(frames[:, -1, :2, 3] - frames[:, 1, :2, 3], axis=1)
    assert (np.diff(shift[np.argsort(reach), 2]) < 1e-12).all() and np.ptp(shift[:, 2]) > 0


def test_every_knock_has_a_way_of_its_own_and_is_not_made_good():
    for seed in SEEDS:
        error = drawn("knocks_on_rubber", plan_of("UR10"), seed) / np.repeat([SIZE, SHIFT], 3)
        moved = np.linalg.norm(error - error[0], axis=1)
        before = int(np.argmax(moved > 1e-9))
        assert 2 <= before < VIEWS / 2 and moved[before] > 0.3 and moved[-1] > 0.1
        assert 2 <= np.linalg.matrix_rank(error - error[0], tol=1e-9) <= 4
