"""Which joint errs by a law without a name: told where it is one joint, and not told where it is all of them."""

from itertools import pairwise

import numpy as np
import pytest

from data_synth import kinematics
from data_synth.ordinary_arm import draw_arm, with_memory
from data_synth.unnamed_laws import UNNAMED
from stitch import frames
from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.unknown.clear_joints import clear_laws
from stitch.diagnosis.unknown.joint_curves import joint_curves
from stitch.diagnosis.unknown.joint_laws import ANY_SIZE, joint_laws, some_law
from stitch.observations.pose_errors import THE_WAY
from tests.diagnosis.freed_blade import freed_blade


@pytest.fixture(scope="module")
def cell():
    """A blade on the flange and its freed views under the true hand-eye."""
    return freed_blade(4, 14)


def with_joints_off(cell, off):
    """The linear model where joints are off by so much, rad (V, n)."""
    return cell.seen(kinematics.flange(cell.measured.plan.arm, cell.measured.plan.joints + off))


def test_a_joint_is_told_where_all_of_them_together_explain_no_more(cell):
    """Friction in joint 5: beside what all joints and links may do its law is not 20 to 1 likelier than none."""
    off = 2 * UNNAMED["hysteresis"](cell.measured.plan, np.random.default_rng(0))
    (joint,) = np.flatnonzero(np.ptp(off, axis=0)) + 1
    linear = with_joints_off(cell, off)
    beside = joint_laws(linear)
    assert beside[0].log_bayes_factor < ODDS + np.log(len(beside))
    assert [law.joint for law in clear_laws(linear)] == [joint]


@pytest.mark.parametrize("size", [0.3, 1.0])
def test_no_joint_is_told_where_all_are_off(cell, size):
    for seed in range(4):
        arm = draw_arm(cell.measured.plan.arm.joints, size, np.random.default_rng(seed))
        assert not clear_laws(cell.seen(arm.flange(cell.measured.plan.arm, cell.measured.plan.joints)))


def test_that_some_law_is_there_is_their_mean_over_a_twentieth():
    """However many kinds of laws are asked for: those that explain nothing take their share of the prior."""
    factors = np.array([50.0, 3.0, 1.0, 0.0])
    asked = some_law(np.log(np.maximum(factors, 1e-300))[:, None])
    assert asked.shape == (1,) and np.exp(asked[0] + ANY_SIZE) == pytest.approx(0.05 * factors.mean())


def test_no_joint_is_told_where_poses_wander(cell):
    for seed in range(4):
        wander = with_memory(14, 0.9, np.random.default_rng(seed)) * np.repeat([4e-5, 0.04], 3)
        assert not clear_laws(cell.seen(cell.measured.T_base_flange @ frames.exp(wander)))


def test_the_course_along_the_move_is_the_true_one_within_its_sigma(cell):
    """A joint that is off by how far it came, but no more beyond some 15°, as no play and no settling is."""
    q = cell.measured.plan.joints
    move = np.diff(q, axis=0, prepend=q[:1])
    off = np.zeros_like(q)
    off[:, 4] = 4e-4 * np.tanh(4 * move[:, 4])
    laws = clear_laws(with_joints_off(cell, off))
    assert [(law.joint, law.follows) for law in laws] == [(5, THE_WAY)]
    course = joint_curves(laws)[0]
    true = 4e-4 * np.tanh(4 * course.angle) - off[:, 4].mean()
    assert (course.name, course.of_move) == ("j5_move_deg", True)
    np.testing.assert_allclose(course.stood, move[:, 4])
    assert np.all(np.abs(course.error - true) < 3 * course.sigma)
    assert all(a <= b + 1e-5 for a, b in pairwise(course.error)) and np.ptp(course.error) > 0.6 * np.ptp(true)
