"""The trend of an effect shows the law that was put into the arm, the mount or the part."""

import numpy as np
import pytest

from data_synth import kinematics
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.effect_trend import EffectTrend, trend_of_candidate
from stitch.diagnosis.score import score
from stitch.effects.contract import EFFECTS
from stitch.numerics import frames
from stitch.observations.linear_model import LinearModel
from tests.diagnosis.freed_blade import FreedBlade, freed_blade

JOINT = 2


@pytest.fixture(scope="module")
def cell() -> FreedBlade:
    return freed_blade(4, 14)


def _trend(linear: LinearModel, effect: str) -> EffectTrend:
    candidate = candidate_of(linear, EFFECTS[effect])
    assert candidate is not None
    trend = trend_of_candidate(linear, score(linear, candidate))
    assert trend is not None
    return trend


def test_a_gear_shows_its_sine_over_the_joints_angle(cell: FreedBlade):
    plan, size = cell.measured.plan, 2e-3
    joints = plan.joints.copy()
    law = size * np.sin(joints[:, JOINT])
    joints[:, JOINT] += law
    trend = _trend(cell.seen(kinematics.flange(plan.arm, joints)), "gear_eccentricity")
    assert (trend.of, trend.value_unit, trend.follows) == ("joint 3", "rad", "angle of joint 3")
    np.testing.assert_allclose(trend.at, np.degrees(plan.joints[:, JOINT]), atol=1e-9)
    off = (trend.measured - law) / trend.sigma
    # What a constant of the joint does the hand-eye does nearly as well.
    assert np.std(off) < 2.5 and np.corrcoef(trend.measured, law)[0, 1] > 0.8
    # Drawn over the whole turn, it is one wave of one turn, and passes through the line at the views.
    angles, wave = np.radians(trend.law[0]), trend.law[1]
    assert np.ptp(angles) == pytest.approx(2 * np.pi)
    once = np.column_stack([np.sin(angles), np.cos(angles)])
    np.testing.assert_allclose(once @ np.linalg.lstsq(once, wave, rcond=None)[0], wave, atol=1e-9)
    np.testing.assert_allclose(np.interp(trend.at, trend.law[0], wave), trend.predicted, atol=2e-6)


def test_a_slip_is_a_step_of_its_size_in_the_order_of_views(cell: FreedBlade):
    """The part is on the flange: it sits elsewhere from view 8 on, where the scanner of the first views was."""
    plan = cell.measured.plan
    T_base_flange = kinematics.flange(plan.arm, plan.joints)
    moved = np.array([0, 0, 0, 0.15, -0.1, 0.05])
    T_base_flange[8:] = T_base_flange[8:] @ frames.exp(moved)
    trend = _trend(cell.seen(T_base_flange), "part_slip")
    assert (trend.of, trend.follows) == ("the part", "view order") and list(trend.views) == list(range(14))
    before, after = trend.measured[:8], trend.measured[8:]
    assert after.mean() - before.mean() == pytest.approx(np.linalg.norm(moved[3:]), rel=0.15)
    np.testing.assert_allclose(trend.predicted[:8], 0, atol=1e-3)
    assert np.abs(trend.measured - trend.predicted).max() < 4 * trend.sigma.max()
    assert trend.law.size == 0
