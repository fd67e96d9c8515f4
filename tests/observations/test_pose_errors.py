"""The prior of pose errors against arms that another kinematics bends, and the hand-eye's sigma on such arms.

What the motions do not show, against the null space of all that a sensor sees, by finite differences.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from data_synth import kinematics
from data_synth.fixtures.blade_cells import captured, measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import with_part
from data_synth.ordinary_arm import draw_arm, with_memory
from data_synth.simulate import simulate
from stitch.diagnosis.residual_structure import variance_budget
from stitch.effects import EFFECTS
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.observations.observability import unobservable
from stitch.observations.pose_errors import prior_pose_errors
from stitch.observations.surfaces.hand_eye_fit import hand_eye_statistics, solve_hand_eye
from stitch.observations.surfaces.surface_model import surface_model
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from tests.observations.honest_arms import BALLS, labelled_session, pose, seen_by

VIEWS, SIZE = 12, 0.5
ALL_ONE = "the axis about which all views were turned"


@pytest.fixture(scope="module")
def cell():
    """A blade on the flange, its measurement and its freed views under the true hand-eye."""
    measured = measured_blade(4, views=VIEWS, pixels=70)
    capture = captured(measured)
    measurement = measurement_of(session_of(measured), capture)
    return measured, measurement, unconstrained_poses(capture, capture.poses(measured.T_mount), 1.0)


def prior_of(cell):
    measured, measurement, freed = cell
    return prior_pose_errors([measurement], Model(measured.T_mount), [freed.overlaps.gram.centre])


def moved(cell, T_base_flange) -> np.ndarray:
    """(V, 6) left twists of the views about the middle of the part when the flange truly is there."""
    measured, measurement, freed = cell
    to_centre = frames.make(np.eye(3), -freed.overlaps.gram.centre)
    model = measurement.capture.poses(measured.T_mount)
    true = frames.inverse(T_base_flange) @ measured.T_mount
    return frames.log(to_centre @ true @ frames.inverse(to_centre @ model))


def about(freed, other, twists) -> np.ndarray:
    """Left twists (V, 6) about the centre of `freed` that count about that of `other`."""
    between = frames.make(np.eye(3), other.overlaps.gram.centre - freed.overlaps.gram.centre)
    return np.asarray(twists @ frames.adjoint(between).T)


def test_offsets_and_links_move_the_views_as_another_kinematics_says(cell):
    """Every error of an arm lies in the span of the prior's components of its kind, at second order of its size."""
    measured, *_ = cell
    prior = prior_of(cell)
    arm, q = measured.scene.arm, measured.plan.joints
    for seed in range(3):
        drawn = draw_arm(arm.joints, SIZE, np.random.default_rng(seed))
        for kind, kept in (("joint_offset", ("offset",)), ("link_geometry", ("a", "d", "alpha"))):
            only = replace(drawn, **{k: 0 * v for k, v in vars(drawn).items() if k not in kept})
            x = moved(cell, only.flange(arm, q)).ravel()
            C = prior.components[prior.names.index(kind)]
            values, vectors = np.linalg.eigh(C)
            seen = vectors[:, values > 1e-12 * values[-1]]
            assert np.linalg.norm(x - seen @ (seen.T @ x)) < 2e-3 * np.linalg.norm(x)


def test_joints_that_scatter_turn_and_move_the_flange_as_another_kinematics_says(cell):
    """A joint at a time: independent errors of all add up in squares."""
    measured, *_ = cell
    arm, q, prior = measured.scene.arm, measured.plan.joints, prior_of(cell)
    size = next(p.typical for p in EFFECTS["joint_offset"].specs.values())
    flange = frames.inverse(kinematics.flange(arm, q))
    turned = [frames.log(flange @ kinematics.flange(arm, q + 1e-6 * joint)) / 1e-6 for joint in np.eye(6)]
    squares = (size * np.array(turned)) ** 2
    by_hand = squares.sum(axis=0).mean(axis=0).reshape(2, 3).mean(axis=1)
    np.testing.assert_allclose(prior.flange_per_joint, by_hand, rtol=1e-4)


def test_an_effect_that_is_asked_for_by_name_is_no_error_of_its_own_kind(cell):
    """Gears without eccentricity are those of two periods a turn; without both there are none."""
    prior = prior_of(cell)
    one = prior.restricted(prior.causes - {"gear_eccentricity"})
    harmonic = prior.effects["gear_harmonic"][1]
    C = one.components[one.names.index("gears")]
    np.testing.assert_allclose(C, harmonic @ harmonic.T, atol=1e-12 * np.abs(C).max())
    assert [n for n in prior.names if n not in one.restricted(one.causes - {"gear_harmonic"}).names] == ["gears"]
    np.testing.assert_array_equal(one.components[0], prior.components[0])


def test_an_arm_of_one_and_the_same_pose_repeats_what_it_does(cell):
    """Two views of one pose: no component of the arm tells them apart, and what stops share is asked for."""
    measured, measurement, freed = cell
    views = measurement.views
    joints = views.joints.copy()
    joints[1] = joints[0]
    T = measurement.T_base_flange.copy()
    T[1] = T[0]
    capture = replace(measurement.capture, T_reference_mount=frames.inverse(T))
    twice = replace(
        measurement,
        capture=capture,
        T_base_flange=T,
        views=replace(views, joints=joints, previous=joints, approach=0 * joints),
    )
    prior = prior_pose_errors([twice], Model(measured.T_mount), [freed.overlaps.gram.centre])
    assert prior.names[-2:] == ("stop rotation", "stop translation")
    difference = np.zeros((6, 6 * VIEWS))
    difference[:, :6], difference[:, 6:12] = np.eye(6), -np.eye(6)
    for name in ("joint_offset", "link_geometry", "gears", "play", "smooth", "stop rotation", "stop translation"):
        C = prior.components[prior.names.index(name)]
        assert np.abs(difference @ C @ difference.T).max() <= 1e-9 * np.abs(C).max()


@pytest.mark.slow
def test_sigmas_hold_on_arms_that_are_a_little_wrong_everywhere(cell):
    """Six arms with every joint and link wrong: χ² of the hand-eye within 99.9 % of 36 numbers; alone it is not."""
    measured, measurement, freed = cell
    arm, q, T = measured.scene.arm, measured.plan.joints, measured.T_mount
    own, prior = freed.twists - freed.twists.mean(axis=0), prior_of(cell)
    squares = np.zeros(2)
    for seed in range(6):
        x = moved(cell, draw_arm(arm.joints, SIZE, np.random.default_rng([seed, 5])).flange(arm, q))
        seen = replace(freed, twists=own + x - x.mean(axis=0))
        for k, errors in enumerate((prior, None)):
            found = hand_eye_statistics(solve_hand_eye([measurement.capture], [seen], T), errors)
            xi = frames.log(frames.inverse(found.T_mount) @ T)
            squares[k] += xi @ np.linalg.solve(found.covariance, xi)
    assert squares[0] < chi2.ppf(0.999, 36)
    assert squares[1] > chi2.ppf(0.999, 36)


@pytest.mark.slow
def test_a_rig_at_equal_poses_knows_its_hand_eye_no_better_than_one_session(cell):
    """Arms that err by pose err alike before a second part. Of independent errors sigmas would fall by √2: the median
    of three arms stays above half-way, and χ² of the rig within 99.9 %."""
    measured, measurement, freed = cell
    arm, q, T = measured.scene.arm, measured.plan.joints, measured.T_mount
    part = with_part(measured.scene, "blade", span=120.0, thickness=0.2)
    other = simulate(part, {}, 4, planned=(measured.plan, np.zeros(VIEWS)))
    np.testing.assert_allclose(other.T_mount, T, atol=1e-12)
    capture = captured(other)
    sessions = [measurement, measurement_of(session_of(other), capture)]
    both, captures = [freed, unconstrained_poses(capture, capture.poses(T), 1.0)], [measurement.capture, capture]
    prior = prior_pose_errors(sessions, Model(T), [f.overlaps.gram.centre for f in both])
    falls, square = [], 0.0
    for seed in range(3):
        x = moved(cell, draw_arm(arm.joints, SIZE, np.random.default_rng(seed)).flange(arm, q))
        seen = [replace(f, twists=f.twists + about(f, freed, x)) for f in both]
        one = hand_eye_statistics(solve_hand_eye(captures[:1], seen[:1], T), prior_of(cell)).covariance
        rig = hand_eye_statistics(solve_hand_eye(captures, seen, T), prior)
        falls.append(np.exp((np.linalg.slogdet(rig.covariance)[1] - np.linalg.slogdet(one)[1]) / 12))
        xi = frames.log(frames.inverse(rig.T_mount) @ T)
        square += xi @ np.linalg.solve(rig.covariance, xi)
    assert np.median(falls) > (1 + np.sqrt(0.5)) / 2
    assert square < chi2.ppf(0.999, 18)


def test_the_budget_adds_up_and_tells_an_ordinary_arm_from_one_that_wanders(cell):
    """All joints and links wrong: most of what is left is the arm's. 0.2 mm and 0.2 mrad of memory: it wanders."""
    measured, measurement, freed = cell
    arm, q = measured.scene.arm, measured.plan.joints
    bent = draw_arm(arm.joints, SIZE, np.random.default_rng(1)).flange(arm, q)
    memory = with_memory(VIEWS, 0.9, np.random.default_rng(2)) * np.repeat([2e-4, 0.2], 3)
    shares = []
    for T in (bent, measured.T_base_flange @ frames.exp(memory)):
        seen = replace(freed, twists=freed.twists + moved(cell, T))
        budget = variance_budget(surface_model(measurement, Model(measured.T_mount), measurement.capture, seen))
        assert sum(line.variance_share for line in budget) == pytest.approx(1.0)
        share = {line.source: line.variance_share for line in budget}
        shares.append((sum(x for name, x in share.items() if "every joint" in name), share["wandering in time"]))
    assert shares[0][0] > 0.5 > shares[0][1]
    assert shares[1][1] > shares[0][1]


def turning_flange(axis, tilt, moving, mount):
    """Flanges (V, 4, 4) that turn about one axis, and by `tilt` about any other, the hand-eye and the targets."""
    rng = np.random.default_rng(3)
    X = pose(rng.normal(size=3), 100 * rng.normal(size=3))
    turns = [np.eye(3)[axis] * rng.uniform(-1, 1) + tilt * rng.normal(size=3) for _ in range(12)]
    flange = [pose(turn, np.array([700, 50, 500.0]) + moving * rng.normal(size=3)) for turn in turns]
    return flange, X, BALLS if mount == "eye_to_hand" else BALLS + np.array([700, 50, 200])


def weakest(flange, X, places, mount):
    """The twist of the hand-eye (mount's axes, about the part) that changes what is seen least, targets free."""
    still = np.random.default_rng(0)
    shown = seen_by(flange, X, places, mount, still, noise=0.0)
    centre = np.mean(shown, axis=(0, 1))
    size = np.linalg.norm(places - places.mean(axis=0), axis=1).mean()
    about = pose(np.zeros(3), centre)

    def seen(x):
        Y = X @ about @ pose(x[:3] / size, x[3:6]) @ np.linalg.inv(about)
        return np.ravel(seen_by(flange, Y, places + x[6:].reshape(-1, 3), mount, still, noise=0.0))

    steps = 0.01 * np.eye(6 + places.size)
    J = np.array([seen(step) - seen(-step) for step in steps]).T / 0.02
    # Targets are free: what of the hand-eye they cannot make up for is what counts.
    Q = np.linalg.qr(J[:, 6:])[0]
    twist = np.linalg.svd(J[:, :6] - Q @ (Q.T @ J[:, :6]))[2][-1]
    return X[:3, :3] @ twist[:3], X[:3, :3] @ twist[3:]


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("tilt", [0.0, 1e-4, 2e-3])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_translation_that_the_turns_hardly_show_is_called_a_translation(axis, tilt, mount):
    flange, X, places = turning_flange(axis, tilt, 100.0, mount)
    turned, shifted = weakest(flange, X, places, mount)
    assert np.linalg.norm(turned) < 0.1 and abs(shifted[axis]) > 0.99
    capture = prepare_capture(
        labelled_session(flange, seen_by(flange, X, places, mount, np.random.default_rng(1)), mount)
    )
    assert unobservable([capture], X) == (f"translation along {ALL_ONE}",)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_at_one_place_the_turn_about_the_axis_is_open_too(axis, mount):
    flange, X, places = turning_flange(axis, 0.0, 0.0, mount)
    capture = prepare_capture(
        labelled_session(flange, seen_by(flange, X, places, mount, np.random.default_rng(1)), mount)
    )
    assert unobservable([capture], X) == (f"translation along {ALL_ONE}", f"rotation about {ALL_ONE}")
