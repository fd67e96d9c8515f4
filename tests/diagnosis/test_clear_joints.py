"""Which joint errs by a law without a name: told where it is one joint, and not told where it is all of them."""

import re
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from data_synth import kinematics
from data_synth.ordinary_arm import draw_arm, with_memory
from stitch.diagnosis.residual_structure import variance_budget
from stitch.diagnosis.sentences import curve_sentences, joint_curve_sentence
from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.unmodelled_joint_effects import (
    ANY_SIZE,
    joint_curves,
    joint_effects,
    log_posterior_of_any,
    significant_joint_effects,
)
from stitch.numerics import frames
from stitch.observations.pose_errors import (
    JOINT_LOAD,
    NOT_OF_ARM,
    TIME_ONLY,
    TRAVEL,
    TWO_ANGLES,
    WAVES,
    WITH_TIME,
    usual_time_step,
)
from tests.diagnosis.freed_blade import freed_blade


@pytest.fixture(scope="module")
def cell():
    """A blade on the flange and its freed views under the true hand-eye."""
    return freed_blade(4, 14)


def with_joints_off(cell, off):
    """The linear model where joints are off by so much, rad (V, n)."""
    return cell.seen(kinematics.flange(cell.measured.plan.arm, cell.measured.plan.joints + off))


def test_a_joint_is_told_where_all_of_them_together_explain_no_more(cell):
    """One that goes with its own angle: beside what all joints and links may do its law is not 20 to 1 likelier."""
    off = np.zeros_like(cell.measured.plan.joints)
    off[:, 4] = 3e-4 * np.sin(2 * cell.measured.plan.joints[:, 4])
    linear = with_joints_off(cell, off)
    assert joint_effects(linear)[0].log_bayes_factor < ODDS
    assert [law.joint for law in significant_joint_effects(linear)] == [5]


@pytest.mark.parametrize("size", [0.3, pytest.param(1.0, marks=pytest.mark.slow)])
def test_no_joint_is_told_where_all_are_off(cell, size):
    for seed in range(2):
        arm = draw_arm(cell.measured.plan.arm.joints, size, np.random.default_rng(seed))
        assert not significant_joint_effects(cell.seen(arm.flange(cell.measured.plan.arm, cell.measured.plan.joints)))


def test_that_some_law_is_there_is_their_mean_over_a_twentieth():
    """However many kinds of laws are asked for: those that explain nothing take their share of the prior."""
    factors = np.array([50.0, 3.0, 1.0, 0.0])
    asked = log_posterior_of_any(np.log(np.maximum(factors, 1e-300))[:, None])
    assert asked.shape == (1,) and np.exp(asked[0] + ANY_SIZE) == pytest.approx(0.05 * factors.mean())


def test_no_joint_is_told_where_poses_wander(cell):
    for seed in range(2):
        wander = with_memory(14, 0.9, np.random.default_rng(seed)) * np.repeat([4e-5, 0.04], 3)
        assert not significant_joint_effects(cell.seen(cell.measured.T_base_flange @ frames.exp(wander)))


def test_the_course_along_the_move_is_the_true_one_within_its_sigma(cell):
    """A joint that is off by how far it came, but no more beyond some 15°, as no play and no settling is."""
    q = cell.measured.plan.joints
    move = np.diff(q, axis=0, prepend=q[:1])
    off = np.zeros_like(q)
    off[:, 4] = 4e-4 * np.tanh(4 * move[:, 4])
    laws = significant_joint_effects(with_joints_off(cell, off))
    assert [(law.joint, law.follows) for law in laws] == [(5, TRAVEL)]
    course = joint_curves(laws)[0]
    true = 4e-4 * np.tanh(4 * np.radians(course.at)) - off[:, 4].mean()
    assert course.covariate == "j5_move_deg"
    np.testing.assert_allclose(course.view_values, np.degrees(move[:, 4]))
    assert np.all(np.abs(course.error - true) < 3 * course.sigma)
    assert all(a <= b + 1e-5 for a, b in pairwise(course.error)) and np.ptp(course.error) > 0.6 * np.ptp(true)


def test_two_joints_that_drag_each_other_are_told_by_the_two_angles(cell):
    """The law is the likeliest of all kinds, and of the joint's partners it is the true one; courses along both."""
    q = cell.measured.plan.joints
    off = np.zeros_like(q)
    off[:, 2] = 3e-4 * np.sin(q[:, 2]) * np.sin(2 * q[:, 4])
    (law,) = significant_joint_effects(with_joints_off(cell, off))
    assert (law.joint, law.follows, law.errors.others[law.process]) == (3, TWO_ANGLES, 4)
    curves = joint_curves([law])
    assert {c.covariate for c in curves} <= {"j3_deg", "j5_deg"} and curves[0].covariate == "j5_deg"


def test_what_a_joint_does_by_two_angles_is_the_mean_over_its_partners(cell):
    """By hand from each partner's own law; and a function of two angles falls off as the product of both."""
    q = cell.measured.plan.joints
    off = np.zeros_like(q)
    off[:, 3] = 2e-4 * np.sin(q[:, 1])
    linear = with_joints_off(cell, off)
    smooth = linear.pose_errors.joint_processes[TWO_ANGLES]
    factors = []
    for p in smooth.of_joint(3):
        own = replace(smooth, joints=(3,), columns=smooth.columns[:, [p]], kernel=smooth.kernel[[p]])
        errors = replace(linear.pose_errors, joint_processes={TWO_ANGLES: own})
        (law,) = joint_effects(replace(linear, pose_errors=errors), [TWO_ANGLES])
        factors.append(np.exp(law.log_bayes_factor))
    whole = next(law for law in joint_effects(linear, [TWO_ANGLES]) if law.joint == 4)
    assert len(factors) == 5 and np.exp(whole.log_bayes_factor) == pytest.approx(np.mean(factors))
    apart = 2 * np.sin(0.5 * np.abs(q[0] - q[5]))
    process = smooth.of_joint(3)[0]
    alike = smooth.kernel_of(process)[0, 5]
    assert alike == pytest.approx(np.exp(-0.5 * (apart[3] ** 2 + apart[smooth.others[process]] ** 2)))


def test_the_teeth_of_a_belt_are_told_as_waves_with_their_period(cell):
    """A saw of 20° along joint 5: its waves are likelier than any function that changes within a few degrees."""
    q = cell.measured.plan.joints
    tooth = np.radians(20.0)
    off = np.zeros_like(q)
    off[:, 4] = 6e-4 * (np.mod(q[:, 4] / tooth, 1.0) - 0.5)
    laws = joint_effects(with_joints_off(cell, off).restricted(NOT_OF_ARM))
    law = laws[0]
    assert (law.joint, law.follows) == (5, WAVES)
    # Half a wave more or less over the range looks alike.
    waves = np.ptp(q[:, 4]) / np.array([tooth, law.errors.periods[law.process]])
    assert abs(waves[0] - waves[1]) <= 0.5
    (course,) = joint_curves([law])
    there = np.radians(course.at)
    again = np.interp(there[:10] + law.errors.periods[law.process], there, course.error)
    np.testing.assert_allclose(again, course.error[:10], atol=0.2 * np.ptp(course.error))


def test_the_course_in_time_of_a_joint_that_warms_is_the_true_one_within_its_sigma(cell):
    steps = np.arange(14.0)
    off = np.zeros_like(cell.measured.plan.joints)
    off[:, 4] = 8e-4 * (1 - np.exp(-steps / 4.0))
    (law,) = significant_joint_effects(with_joints_off(cell, off))
    assert (law.joint, law.follows) == (5, TIME_ONLY)
    (course,) = joint_curves([law])
    assert course.covariate == "time_s"
    at = (course.at - course.at.min()) / usual_time_step(law.model.measurement)
    true = 8e-4 * (1 - np.exp(-at / 4.0)) - off[:, 4].mean()
    assert np.all(np.abs(course.error - true) < 4 * course.sigma)
    assert np.corrcoef(course.error, true)[0, 1] > 0.9
    assert re.fullmatch(
        r"Joint 5 is off by -\S+ ± \S+ mrad 0 s into the session, and by .*", joint_curve_sentence(course)
    )


def test_a_joint_that_swings_in_time_does_so_at_every_pose_and_its_share_is_no_scatter(cell):
    """Half a milliradian: all of what the joint does goes with time, and the budget holds it in place of scatter."""
    off = np.zeros_like(cell.measured.plan.joints)
    off[:, 4] = 5e-4 * np.sin(0.7 * np.arange(14.0))
    linear = with_joints_off(cell, off)
    law = next(law for law in joint_effects(linear) if law.follows == TIME_ONLY)
    (course,) = joint_curves([law])
    assert law.joint == 5 and course.covariate == "time_s" and course.share > 0.9
    assert np.ptp(course.error) == pytest.approx(np.ptp(off[:, 4]), rel=0.2)
    budget = {line.source: line.variance_share for line in variance_budget(law.model)}
    assert max(budget, key=budget.get) == "joint 5 by no known law"
    # What is left to scatter is less than a third of what the joint did.
    assert np.sqrt(law.model.flange_scatter(law.model.null)[0]) < off[:, 4].std() / 3


def test_what_a_joint_may_follow_as_well_is_said(cell):
    """With a slower swing the poses of these views go as time does."""
    off = np.zeros_like(cell.measured.plan.joints)
    off[:, 4] = 5e-4 * np.sin(0.5 * np.arange(14.0))
    linear = with_joints_off(cell, off)
    factors = {law.follows: law.log_bayes_factor for law in joint_effects(linear) if law.joint == 5}
    (law,) = significant_joint_effects(linear)
    assert (factors[WITH_TIME] > max(factors.values()) - ODDS) and law.may_follow == ("the joint angles", "time")
    found = SimpleNamespace(curves=joint_curves([law]), time_curve=None)
    assert "These views do not tell whether joint 5 follows the joint angles or time." in curve_sentences(found, "mm")


def test_the_course_under_load_of_a_spring_that_stiffens_is_the_true_one_within_its_sigma(cell):
    plan, torques = cell.measured.plan, with_joints_off(cell, 0.0).measurement.views.torques
    load = torques.values[:, torques.names.index("2")]
    yields = Polynomial.fit(load, (load / np.abs(load).max()) ** 3, 5)
    off = np.zeros_like(plan.joints)
    off[:, 1] = 1e-3 * yields(load)
    laws = joint_effects(with_joints_off(cell, off).restricted(NOT_OF_ARM))
    (course,) = joint_curves([next(law for law in laws if law.joint == 2 and law.follows == JOINT_LOAD)])
    assert course.covariate == "j2_torque_nm"
    true = 1e-3 * yields(course.at) - off[:, 1].mean()
    assert np.all(np.abs(course.error - true) < 4 * course.sigma)
    assert np.corrcoef(course.error, true)[0, 1] > 0.9
    assert re.search(r" under -?\d+ N m, and by .* under -?\d+ N m\. That is", joint_curve_sentence(course))
