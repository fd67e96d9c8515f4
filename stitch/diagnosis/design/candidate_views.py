"""Views that nobody has taken yet, and how they would answer to a model and to two candidate effects."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stitch import frames
from stitch.diagnosis.design.candidate_targets import candidate_rows
from stitch.diagnosis.score import Score
from stitch.frames import Array
from stitch.measurement import robot as kinematics
from stitch.measurement.capture import build_capture
from stitch.measurement.measurement import Measurement
from stitch.measurement.robot import Robot
from stitch.measurement.torques import PAYLOAD, Torques, torques_of
from stitch.measurement.views import Views
from stitch.model.forward import moves_points, perturbed_frames
from stitch.model.jacobian import pose_derivatives
from stitch.model.model import Model
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import SurfaceObservation
from stitch.observations.targets.target_model import TargetObservation
from stitch.statistics.variance_prior import NOISE

_SAMPLES = 6000
_TRIED = 250
_SPREAD = np.radians(40.0)  # about joint angles that were driven before
_LIMIT = np.radians(170.0)  # of joints whose limits nobody stated, unless they were beyond already
# A view may see the part by this share of its distance farther off than any before, and turned by so much.
_MARGIN, _TURNED = 0.15, np.cos(np.radians(50.0))


@dataclass(frozen=True)
class CandidateViews:
    """K views with m numbers each, before whitening."""

    joints: Array  # (K, n) rad
    design: Array  # (K, m, a) per column of the model
    a: Array  # (K, m, p) per free parameter of one effect
    b: Array  # (K, m, q) of the other
    half: Array  # (K, m, m) Cholesky factors of the scatter of one view


def _of_surfaces(linear: LinearModel, seen: SurfaceObservation, a: Score, b: Score) -> CandidateViews | None:
    """Poses in which the scanner would see the part about as it has before; None if poses cannot show the effects."""
    zero = [s.form.at(np.zeros(len(s.values))) for s in (a, b)]
    T_mount, centre = linear.model.T_mount, seen.unconstrained.overlaps.gram.centre

    def poses_of(joints: Array) -> Array:
        assert linear.measurement.robot is not None
        T = kinematics.forward(linear.measurement.robot, joints)
        return build_capture("candidates", (), T, linear.measurement.mount).poses(T_mount)

    joints = reachable(linear.measurement.views.joints, poses_of, seen.capture.poses(T_mount), centre)[:_TRIED]
    if moves_points(zero) or not len(joints):
        return None
    measurement, bare = candidate_measurement(linear.measurement, joints), Model(T_mount)
    to_centre = frames.make(np.eye(3), -centre)
    own = frames.adjoint(to_centre @ (perturbed_frames(measurement, ())[0] @ bare.T_mount))
    extra = np.zeros((len(joints), 6, linear.white_design.shape[1] - 6))
    found = pose_derivatives(measurement, bare, zero, centre)
    of_a, of_b = (c[s.form.keep].transpose(1, 2, 0) for c, s in zip(found, (a, b), strict=True))
    half = _view_scatter(linear, measurement, to_centre)
    return CandidateViews(joints, np.concatenate([own, extra], axis=2), of_a, of_b, half)


def _of_targets(linear: LinearModel, seen: TargetObservation, a: Score, b: Score) -> CandidateViews:
    """Poses near those driven, in which all targets are seen."""
    joints = nearby(linear.measurement.views.joints)[:_TRIED]
    measurement = candidate_measurement(linear.measurement, joints)
    zero = [s.form.at(np.zeros(len(s.values))) for s in (a, b)]
    flange_and_noise = np.append(linear.flange_scatter(linear.null), linear.null.variances[NOISE])
    rows, columns, covariance = candidate_rows(measurement, seen.rows, seen.landmarks, flange_and_noise, zero)
    extra = np.zeros((*rows.residual.shape, linear.design.shape[1] - 6 - rows.landmarks.shape[2]))
    design = np.concatenate([rows.hand_eye, rows.landmarks, extra], axis=2)
    of_a, of_b = (c[..., s.form.keep] for c, s in zip(columns, (a, b), strict=True))
    return CandidateViews(joints, design, of_a, of_b, np.asarray(np.linalg.cholesky(covariance), float))


# What was observed, and how it would look in a further view; nothing is proposed for what is not in here.
_VIEWS_BY_OBSERVATION: dict[type, Callable[[LinearModel, Any, Score, Score], CandidateViews | None]] = {
    SurfaceObservation: _of_surfaces,
    TargetObservation: _of_targets,
}


def candidate_views(linear: LinearModel, a: Score, b: Score) -> CandidateViews | None:
    """Further views of a session for two effects; None if no pose can show them."""
    of = _VIEWS_BY_OBSERVATION.get(type(linear.observation))
    return None if of is None else of(linear, linear.observation, a, b)


def nearby(seen: Array) -> Array:
    """(K, n) joint angles near those that were driven (V, n), within the limits that were kept."""
    rng = np.random.default_rng(0)
    joints = seen[rng.integers(0, len(seen), _SAMPLES)] + rng.uniform(-_SPREAD, _SPREAD, (_SAMPLES, seen.shape[1]))
    limit = np.maximum(_LIMIT, np.abs(seen).max(axis=0))
    return np.asarray(joints[(np.abs(joints) < limit).all(axis=1)])


def reachable(seen: Array, poses_of: Callable[[Array], Array], seen_from: Array, centre: Array) -> Array:
    """(K, n) joint angles in which the scanner sees the part about as it has before.

    Args:
        seen: (V, n) joint angles that were driven.
        poses_of: T_reference_scanner (K, 4, 4) at joint angles (K, n).
        seen_from: the same (V, 4, 4) of the views that there are.
        centre: (3,) of what they see, reference frame.
    """
    joints = nearby(seen)
    poses = poses_of(joints)
    there = frames.transform(frames.inverse(poses), centre[None])[:, 0]
    before = frames.transform(frames.inverse(seen_from), centre[None])[:, 0]
    margin = _MARGIN * np.linalg.norm(before, axis=1).mean()
    inside = ((there > before.min(axis=0) - margin) & (there < before.max(axis=0) + margin)).all(axis=1)
    # A view direction far from all others would share no surface with them.
    inside &= (poses[:, :3, 2] @ seen_from[:, :3, 2].T).max(axis=1) > _TURNED
    return np.asarray(joints[inside])


def candidate_measurement(measurement: Measurement, joints: Array) -> Measurement:
    """The measurement with views that nobody has taken yet, right after the last one, each approached from there."""
    assert measurement.robot is not None
    views, count = measurement.views, len(joints)
    last = np.repeat(views.joints[-1:], count, axis=0)
    torques = _torques_at(measurement.robot, views, joints)
    pause = float(np.median(np.diff(views.time))) if views.has("time") and views.count > 1 else 0.0
    # They would be taken at rest.
    velocity = None if views.velocity is None else np.zeros_like(joints)
    candidate = replace(
        views,
        count=count,
        joints=joints,
        previous=last,
        approach=np.sign(joints - last),
        time=np.full(count, views.time[-1] + pause),
        velocity=velocity,
        torques=torques,
        covariates={name: np.full(count, values[-1]) for name, values in views.covariates.items()},
        number=np.full(count, views.number[-1] + 1),
    )
    T_base_flange = kinematics.forward(measurement.robot, joints)
    return replace(measurement, views=candidate, T_base_flange=T_base_flange, scan_views=())


def _view_scatter(linear: LinearModel, measurement: Measurement, to_centre: Array) -> Array:
    """(K, 6, 6) Cholesky factors of the pose scatter of one view about the centre."""
    T = measurement.T_base_flange
    carried = frames.adjoint(to_centre @ (np.broadcast_to(np.eye(4), T.shape) if measurement.eye_to_hand else T))
    variances = np.repeat(np.maximum(linear.flange_scatter(linear.null), 1e-300), 3)
    return np.asarray(np.linalg.cholesky(carried * variances @ carried.transpose(0, 2, 1)))


def _torques_at(robot: Robot, views: Views, joints: Array) -> Torques:
    """At joint angles (K, n), with the last view's payload; measured ones as at the nearest pose of all views."""
    if views.torques.measured:
        near = np.linalg.norm(joints[:, None] - views.joints[None], axis=2).argmin(axis=1)
        return replace(views.torques, values=views.torques.values[near])
    carried = views.covariates.get(PAYLOAD)
    return torques_of(robot, joints, None if carried is None else np.full(len(joints), carried[-1]))
