"""Joints that err by no law of the library get no name, and are told where it is one of them and not all."""

import re
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from data_synth import kinematics
from data_synth.laws.unnamed import UNNAMED
from data_synth.ordinary_arm import draw_arm, with_memory
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.residual_structure import variance_budget
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.sentences import curve_sentences, joint_curve_sentence
from stitch.diagnosis.thresholds import IMPLAUSIBLE, ODDS
from stitch.diagnosis.unmodelled_joint_effects import (
    SIZE_PENALTY,
    joint_curves,
    joint_effects,
    log_posterior_of_any,
    significant_joint_effects,
)
from stitch.diagnosis.unmodelled_time_effects import find_repeating_errors
from stitch.effects.contract import EFFECTS
from stitch.numerics import frames
from stitch.numerics.reml import MAY_BE_ABSENT, NOISE, log_prior
from stitch.observations.pose_errors import (
    ALL_ANGLES,
    JOINT_LOAD,
    NOT_OF_ARM,
    OWN_ANGLE,
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
    assert [effect.joint for effect in significant_joint_effects(linear)] == [5]


@pytest.mark.parametrize("size", [0.3, pytest.param(1.0, marks=pytest.mark.slow)])
def test_no_joint_is_told_where_all_are_off(cell, size):
    for seed in range(2):
        arm = draw_arm(cell.measured.plan.arm.joints, size, np.random.default_rng(seed))
        assert not significant_joint_effects(cell.seen(arm.flange(cell.measured.plan.arm, cell.measured.plan.joints)))


def test_that_some_law_is_there_is_their_mean_over_a_twentieth():
    """However many kinds of laws are asked for: those that explain nothing take their share of the prior."""
    factors = np.array([50.0, 3.0, 1.0, 0.0])
    asked = log_posterior_of_any(np.log(np.maximum(factors, 1e-300))[:, None])
    assert asked.shape == (1,) and np.exp(asked[0] + SIZE_PENALTY) == pytest.approx(0.05 * factors.mean())


def test_no_joint_is_told_where_poses_wander(cell):
    for seed in range(2):
        wander = with_memory(14, 0.9, np.random.default_rng(seed)) * np.repeat([4e-5, 0.04], 3)
        assert not significant_joint_effects(cell.seen(cell.measured.T_base_flange @ frames.exp(wander)))


def test_the_curve_along_the_move_is_the_true_one_within_its_sigma(cell):
    """A joint that is off by how far it came, but no more beyond some 15°, as no play and no settling is."""
    q = cell.measured.plan.joints
    move = np.diff(q, axis=0, prepend=q[:1])
    off = np.zeros_like(q)
    off[:, 4] = 4e-4 * np.tanh(4 * move[:, 4])
    effects = significant_joint_effects(with_joints_off(cell, off))
    assert [(effect.joint, effect.follows) for effect in effects] == [(5, TRAVEL)]
    course = joint_curves(effects)[0]
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
    (effect,) = significant_joint_effects(with_joints_off(cell, off))
    assert (effect.joint, effect.follows, effect.errors.others[effect.process]) == (3, TWO_ANGLES, 4)
    curves = joint_curves([effect])
    assert {c.covariate for c in curves} <= {"j3_deg", "j5_deg"} and curves[0].covariate == "j5_deg"


def of_kind(linear, kind):
    """Return a model in which single joints may err by functions of one kind alone."""
    errors = linear.pose_errors
    return replace(linear, pose_errors=replace(errors, joint_processes={kind: errors.joint_processes[kind]}))


def test_the_effect_of_two_angles_is_the_mean_over_a_joints_partners(cell):
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
        (effect,) = joint_effects(replace(linear, pose_errors=errors))
        factors.append(np.exp(effect.log_bayes_factor))
    whole = next(effect for effect in joint_effects(of_kind(linear, TWO_ANGLES)) if effect.joint == 4)
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
    effects = joint_effects(with_joints_off(cell, off).restricted(NOT_OF_ARM))
    effect = effects[0]
    assert (effect.joint, effect.follows) == (5, WAVES)
    # Half a wave more or less over the range looks alike.
    waves = np.ptp(q[:, 4]) / np.array([tooth, effect.errors.periods[effect.process]])
    assert abs(waves[0] - waves[1]) <= 0.5
    (course,) = joint_curves([effect])
    there = np.radians(course.at)
    again = np.interp(there[:10] + effect.errors.periods[effect.process], there, course.error)
    np.testing.assert_allclose(again, course.error[:10], atol=0.2 * np.ptp(course.error))


def test_the_course_in_time_of_a_joint_that_warms_is_the_true_one_within_its_sigma(cell):
    steps = np.arange(14.0)
    off = np.zeros_like(cell.measured.plan.joints)
    off[:, 4] = 8e-4 * (1 - np.exp(-steps / 4.0))
    (effect,) = significant_joint_effects(with_joints_off(cell, off))
    assert (effect.joint, effect.follows) == (5, TIME_ONLY)
    (course,) = joint_curves([effect])
    assert course.covariate == "time_s"
    at = (course.at - course.at.min()) / usual_time_step(effect.model.measurement)
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
    effect = next(effect for effect in joint_effects(linear) if effect.follows == TIME_ONLY)
    (course,) = joint_curves([effect])
    assert effect.joint == 5 and course.covariate == "time_s" and course.share > 0.9
    assert np.ptp(course.error) == pytest.approx(np.ptp(off[:, 4]), rel=0.2)
    budget = {line.source: line.variance_share for line in variance_budget(effect.model)}
    assert max(budget, key=budget.get) == "joint 5 by no known law"
    # What is left to scatter is less than a third of what the joint did.
    assert np.sqrt(effect.model.flange_scatter(effect.model.null)[0]) < off[:, 4].std() / 3


def test_all_that_a_joint_may_follow_is_said(cell):
    """With a slower swing the poses of these views go as time does."""
    off = np.zeros_like(cell.measured.plan.joints)
    off[:, 4] = 5e-4 * np.sin(0.5 * np.arange(14.0))
    linear = with_joints_off(cell, off)
    factors = {effect.follows: effect.log_bayes_factor for effect in joint_effects(linear) if effect.joint == 5}
    (effect,) = significant_joint_effects(linear)
    assert (factors[WITH_TIME] > max(factors.values()) - ODDS) and effect.may_follow == ("the joint angles", "time")
    found = SimpleNamespace(curves=joint_curves([effect]), time_curve=None)
    assert "These views do not tell whether joint 5 follows the joint angles or time." in curve_sentences(found, "mm")


def test_the_course_under_load_of_a_spring_that_stiffens_is_the_true_one_within_its_sigma(cell):
    plan, torques = cell.measured.plan, with_joints_off(cell, 0.0).measurement.views.torques
    load = torques.values[:, torques.names.index("2")]
    yields = Polynomial.fit(load, (load / np.abs(load).max()) ** 3, 5)
    off = np.zeros_like(plan.joints)
    off[:, 1] = 1e-3 * yields(load)
    effects = joint_effects(with_joints_off(cell, off).restricted(NOT_OF_ARM))
    (course,) = joint_curves([next(effect for effect in effects if effect.joint == 2 and effect.follows == JOINT_LOAD)])
    assert course.covariate == "j2_torque_nm"
    true = 1e-3 * yields(course.at) - off[:, 1].mean()
    assert np.all(np.abs(course.error - true) < 4 * course.sigma)
    assert np.corrcoef(course.error, true)[0, 1] > 0.9
    assert re.search(r" under -?\d+ N m, and by .* under -?\d+ N m\. That is", joint_curve_sentence(course))


# Effects that move views as wholes; those of points take longer to ask for.
ASKED = (
    *(
        "joint_offset",
        "link_geometry",
        "joint_compliance",
        "gear_eccentricity",
        "gear_harmonic",
        "backlash",
        "settling",
    ),
    *("robot_thermal_growth", "mount_drift", "fixture_drift"),
)


def said_of(cell, T_base_flange):
    """Verdict and linear model where the flange truly is there."""
    linear = cell.seen(T_base_flange)
    candidates = [c for name in ASKED if (c := candidate_of(linear, EFFECTS[name])) is not None]
    return gather_evidence(linear, candidates, ScatterLimit(*IMPLAUSIBLE)), linear


def test_an_offset_of_one_joint_is_named(cell):
    measured = cell.measured
    q = measured.plan.joints + np.array([0, 0, 0, 1.5e-3, 0, 0])
    found, _ = said_of(cell, kinematics.flange(measured.plan.arm, q))
    assert found.verdict in ("missing_effect", "cannot_tell")
    assert "joint_offset" in [r.name for r in found.named]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_poses_that_wander_get_no_name(cell, seed):
    """0.6 mm and 0.6 mrad that every view hands on to the next: no drift, no settling, no growth."""
    wander = with_memory(14, 0.9, np.random.default_rng(seed)) * np.repeat([6e-4, 0.6], 3)
    found, _ = said_of(cell, cell.measured.T_base_flange @ frames.exp(wander))
    assert found.verdict == "unknown_effect" and not found.named


@pytest.mark.parametrize(
    ("law", "seed", "joint"),
    [
        ("dress_pack", 2, 2),
        *(
            pytest.param(*further, marks=pytest.mark.slow)
            for further in (("spall", 3, 5), ("coupling", 1, 3), ("coupling", 3, 2), ("ripple", 4, 4), ("ripple", 1, 3))
        ),
    ],
)
def test_a_joint_that_follows_no_known_law_gets_no_name_but_its_number(cell, law, seed, joint):
    """0.3 mrad by laws of no library, which beside all joints and links at once look like one of them."""
    measured = cell.measured
    off = 2 * UNNAMED[law](measured.plan, np.random.default_rng(seed))
    assert np.flatnonzero(np.abs(off).sum(axis=0)) + 1 == joint
    found, linear = said_of(cell, kinematics.flange(measured.plan.arm, measured.plan.joints + off))
    assert found.verdict == "unknown_effect" and not found.named
    assert find_repeating_errors(linear)[0].words == f"follow the joints, joint {joint} above all"


@pytest.mark.slow
def test_friction_is_neither_play_nor_settling(cell):
    """A joint that follows its last reversals as dry friction on a spring does; play and settling of it keep their
    names."""
    measured, measurement = cell.measured, cell.measurement
    q, views = measured.plan.joints, measurement.views
    found, _ = said_of(
        cell,
        kinematics.flange(measured.plan.arm, q + 2 * UNNAMED["hysteresis"](measured.plan, np.random.default_rng(0))),
    )
    assert found.verdict == "unknown_effect" and not found.named
    fifth = np.eye(6)[4]
    for name, off in (("backlash", 3e-4 * views.approach), ("settling", 2e-3 * (q - views.previous))):
        found, _ = said_of(cell, kinematics.flange(measured.plan.arm, q + off * fifth))
        assert [r.name for r in found.named] == [name]


def test_a_flank_that_changes_with_the_load_is_no_spring(cell):
    """A joint that errs by the sign of its load alone, and one that yields to it."""
    plan, fifth = cell.measured.plan, np.eye(6)[4]
    torque = plan.torque[:, 4]
    flank = np.tanh((torque - np.median(torque)) / (0.2 * torque.std()))
    found, _ = said_of(cell, kinematics.flange(plan.arm, plan.joints + (2e-4 * flank)[:, None] * fifth))
    assert found.verdict == "unknown_effect" and not found.named
    found, _ = said_of(cell, kinematics.flange(plan.arm, plan.joints + (2e-5 * torque)[:, None] * fifth))
    assert [r.name for r in found.named] == ["joint_compliance"]


def test_only_joints_that_are_bent_have_a_law_of_their_load(cell):
    """The first axis stands upright, and the payload hangs on the sixth: what is left there is rounding."""
    torque = cell.measurement.views.torques.values
    assert np.ptp(torque[:, [0, 5]], axis=0).max() < 1e-9 and np.ptp(torque[:, 1:5], axis=0).min() > 1
    linear = cell.seen(cell.measured.T_base_flange)
    law = linear.pose_errors.joint_processes[JOINT_LOAD]
    assert law.joints == (1, 2, 3, 4)
    for process in range(4):
        np.testing.assert_allclose(np.diag(law.kernel_of(process)), 1)


def test_effects_of_a_joint_in_time_and_under_load_stand_against_every_name(cell):
    """A joint that drifts as its motor warms is likelier by a law in time than by any of its angles."""
    plan = cell.measured.plan
    warm = 1e-3 * (1 - np.exp(-np.arange(len(plan.joints)) / 4.0))
    linear = cell.seen(kinematics.flange(plan.arm, plan.joints + warm[:, None] * np.eye(6)[4]))
    base = linear.restricted(linear.causes - {"joint_offset"})
    found = {kind: joint_effects(of_kind(base, kind)) for kind in (ALL_ANGLES, OWN_ANGLE, WITH_TIME, JOINT_LOAD)}
    best = {kind: max(law.log_bayes_factor for law in laws) for kind, laws in found.items()}
    assert best[WITH_TIME] > max(own for kind, own in best.items() if kind != WITH_TIME)


def test_a_joint_law_is_at_least_as_likely_as_at_sizes_tried_by_hand(cell):
    """Against the density of what the hand-eye leaves, by scipy: scatter, the law at many sizes, of all else little."""
    measured = cell.measured
    off = 2 * UNNAMED["coupling"](measured.plan, np.random.default_rng(1))
    linear = cell.seen(kinematics.flange(measured.plan.arm, measured.plan.joints + off))
    law, errors = joint_effects(linear)[0], linear.pose_errors
    free = null_space(linear.mixed.A[0].T).T
    R, usual = free @ linear.observation.reduced_poses.reduction, errors.scales[errors.names.index("smooth")]
    every = [free @ C @ free.T for C in linear.mixed.components[:, 0]]
    own = R @ law.errors.twist_covariance(law.process) @ R.T
    with_it = replace(
        errors.prior,
        scales=np.append(errors.scales, usual),
        shapes=np.append(errors.prior.shapes, MAY_BE_ABSENT),
        common_factor=np.append(errors.arm_components, True),
    )

    def likely(variances, components, further):
        covariance = np.tensordot(variances, components, axes=1)
        prior = log_prior(np.log(variances), further)[0]
        return multivariate_normal(cov=covariance).logpdf(free @ linear.mixed.z[0]) - 0.5 * prior

    without = likely(linear.null.variances, every, errors.prior)
    scatter = linear.null.variances[: NOISE + 1]
    tried = [
        np.concatenate([scatter * share, 1e-3 * errors.scales**2, [times * usual**2]])
        for share in (0.3, 1.0)
        for times in np.geomspace(1e-2, 1e4, 100)
    ]
    by_hand = max(likely(variances, [*every, own], with_it) for variances in tried) - without
    assert 5 < by_hand < law.log_bayes_factor + 0.02


def test_no_joint_follows_a_law_where_nothing_is_wrong(cell):
    measured = cell.measured
    linear = cell.seen(measured.T_base_flange)
    assert max(law.log_bayes_factor for law in joint_effects(linear)) < 1


# Seven periods a turn are no smooth function of all joints, and told along the joint's own angle alone.
@pytest.mark.parametrize(("joint", "along", "periods"), [(3, 4, 2), (5, 5, 7)])
def test_the_curve_of_a_joint_is_the_true_one_within_its_sigma(cell, joint, along, periods):
    q = cell.measured.plan.joints
    off = np.zeros_like(q)
    off[:, joint - 1] = 4e-4 * np.sin(periods * q[:, along - 1])
    course = joint_curves(significant_joint_effects(with_joints_off(cell, off)))[0]
    true = 4e-4 * np.sin(periods * np.radians(course.at)) - off[:, joint - 1].mean()
    assert (course.joint, course.covariate) == (joint, f"j{along}_deg")
    assert np.all(np.abs(course.error - true) < 4 * course.sigma)
    assert np.corrcoef(course.error, true)[0, 1] > 0.9
    # Where views stood the sigma is worth something: a fifth of what there is.
    low, high = np.degrees(np.quantile(q[:, along - 1], [0.1, 0.9]))
    inside = course.sigma[(course.at > low) & (course.at < high)]
    assert periods > 2 or (inside.max() < 0.2 * np.ptp(true) and course.share > 0.9)
