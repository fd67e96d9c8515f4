"""Laws of the blind test: sizes, shapes, and that each is drawn anew for every arm."""

import numpy as np
import pytest

from data_synth import kinematics
from data_synth.arms import ARMS, with_payload
from data_synth.foreign_laws import FOREIGN, FOREIGN_IN_TIME, FOREIGN_OF_FLANGE
from data_synth.moment import Plan

SIZE, SHIFT = 1.5e-4, 0.05
VIEWS, SEEDS = 40, range(8)


def plan_of(name: str, *, masses: bool = True, useful: tuple[int, ...] = ()) -> Plan:
    """Views all over the middle half of what the joints can do."""
    arm = with_payload(ARMS[name], 3.0, (10.0, 0.0, 80.0))
    span = 0.25 * (arm.upper - arm.lower)
    q = (arm.lower + arm.upper) / 2 + span * np.random.default_rng(5).uniform(-1, 1, (VIEWS, arm.joints))
    torque = kinematics.gravity_torques(arm, q) if masses else 0 * q
    return Plan(q, torque, 0 * q, arm, useful or tuple(range(arm.joints)))


def drawn(law: str, plan: Plan, seed: int, **time: np.ndarray) -> np.ndarray:
    """Errors of one arm."""
    return FOREIGN[law](plan, np.random.default_rng(seed), **time)


def relative(error: np.ndarray, joints: int) -> float:
    """rms over the usual one; of a flange the larger of turn and shift."""
    if error.shape[1] == joints and (error == 0).all(axis=0).sum() == joints - 1:
        return float(np.sqrt((error**2).sum(axis=1).mean())) / SIZE
    return float((np.sqrt((error.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0)) / [SIZE, SHIFT]).max())


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("law", FOREIGN)
def test_errors_are_of_a_good_arms_size_and_differ_from_view_to_view(law, arm):
    plan = plan_of(arm)
    for seed in SEEDS:
        error = drawn(law, plan, seed)
        assert error.shape == (VIEWS, 6 if law in FOREIGN_OF_FLANGE else plan.arm.joints) and np.isfinite(error).all()
        assert 0.5 < relative(error, plan.arm.joints) < 2
        assert error.std(axis=0).max() > 0


@pytest.mark.parametrize("law", FOREIGN)
def test_a_seed_says_which_arm_it_is(law):
    plan = plan_of("KUKA KR30-3")
    arms = [drawn(law, plan, seed) for seed in SEEDS]
    assert np.array_equal(arms[0], drawn(law, plan, 0))
    assert all(np.abs(arms[0] - other).max() > 0 for other in arms[1:])


@pytest.mark.parametrize("law", FOREIGN)
@pytest.mark.parametrize("useful", [(0,), (3,), (5,)])
def test_neither_masses_nor_many_useful_joints_are_needed(law, useful):
    plan = plan_of("UR10", masses=False, useful=useful)
    error = drawn(law, plan, 1)
    assert np.isfinite(error).all() and error.std(axis=0).max() > 0
    if law in ("slack_cable", "scale_segments", "motor_heat"):
        assert set(np.flatnonzero(np.ptp(error, axis=0))) == set(useful)


def test_what_follows_time_follows_it_and_not_the_joints():
    one, other = plan_of("UR10"), plan_of("KUKA KR30-3")
    for law in FOREIGN_IN_TIME:
        assert np.array_equal(drawn(law, one, 2), drawn(law, other, 2))
    pauses = np.cumsum(np.random.default_rng(0).uniform(0.5, 3.0, VIEWS))
    for law in (*FOREIGN_IN_TIME, "softening_belt"):
        late = drawn(law, one, 2, time=pauses)
        assert np.isfinite(late).all() and not np.array_equal(late, drawn(law, one, 2))
        assert np.allclose(late, drawn(law, one, 2, time=pauses + 100.0))


def test_a_loose_anchor_leaves_the_base_where_the_arm_leans_away():
    """Views among the first fifth are never tipped, and all tip about one axis of the base."""
    plan = plan_of("KUKA KR30-3")
    turns = drawn("loose_anchor", plan, 3)[:, :3]
    assert VIEWS / 5 <= (np.abs(turns).max(axis=1) == 0).sum() <= VIEWS / 2
    axes = np.einsum("vij,vj->vi", kinematics.flange(plan.arm, plan.joints)[:, :3, :3], turns)
    values = np.linalg.svd(axes, compute_uv=False)
    assert values[1] < 1e-9 * values[0] and np.abs(axes[:, 2]).max() < 1e-12
