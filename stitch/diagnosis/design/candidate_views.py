"""Views that nobody has taken yet, and how they would answer to a model and to two suspects."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stitch import frames
from stitch.diagnosis.candidates import with_values
from stitch.diagnosis.design.candidate_targets import candidate_rows
from stitch.diagnosis.score import Score
from stitch.frames import Array
from stitch.measurement import robot as kinematics
from stitch.measurement.measurement import Measurement
from stitch.measurement.views import torques_of
from stitch.model.forward import placed
from stitch.model.jacobian import twists
from stitch.observations.surfaces.point_effects import POINTS
from stitch.observations.surfaces.pose_evidence import PoseEvidence
from stitch.observations.targets.target_evidence import TargetEvidence

_SAMPLES = 6000
_TRIED = 250
_SPREAD = np.radians(40.0)  # about joint angles that were driven before
_LIMIT = np.radians(170.0)  # of joints whose limits nobody stated, unless they were beyond already


@dataclass(frozen=True)
class CandidateViews:
    """K views with m numbers each, in the units of the evidence before whitening."""

    joints: Array  # (K, n) rad
    model: Array  # (K, m, a) per column of the model
    a: Array  # (K, m, p) per free parameter of one suspect
    b: Array  # (K, m, q) of the other
    half: Array  # (K, m, m) Cholesky factors of the scatter of one view


def candidate_poses(evidence: PoseEvidence, a: Score, b: Score) -> CandidateViews | None:
    """Poses in which the scanner would see the part about as it has before; None if poses cannot show the suspects."""
    if a.candidate.effect.place in POINTS or b.candidate.effect.place in POINTS:
        return None
    joints = _reachable(evidence)
    if not len(joints):
        return None
    measurement = candidate_measurement(evidence.measurement, joints)
    carrier = placed(measurement, ())[0] @ evidence.T_mount
    own = frames.adjoint(frames.make(np.eye(3), -evidence.freed.overlaps.gram.centre) @ carrier)
    extra = np.zeros((len(joints), 6, evidence.white_model.shape[1] - 6))
    model, of_a, of_b = (
        np.concatenate([own, extra], axis=2),
        _rows(evidence, measurement, a),
        _rows(evidence, measurement, b),
    )
    return CandidateViews(joints, model, of_a, of_b, _view_scatter(evidence, measurement))


def candidate_targets(evidence: TargetEvidence, a: Score, b: Score) -> CandidateViews:
    """Poses near those driven, in which all targets are seen."""
    joints = nearby(evidence.measurement)[:_TRIED]
    measurement = candidate_measurement(evidence.measurement, joints)
    terms = [with_values(s.form, np.zeros(len(s.values))) for s in (a, b)]
    rows, columns, covariance = candidate_rows(
        measurement, evidence.rows, evidence.landmarks, evidence.null.variances, terms
    )
    extra = np.zeros((*rows.residual.shape, evidence.model.shape[1] - 6 - rows.landmarks.shape[2]))
    model = np.concatenate([rows.hand_eye, rows.landmarks, extra], axis=2)
    free = [c[..., s.form.keep] for c, s in zip(columns, (a, b), strict=True)]
    return CandidateViews(joints, model, free[0], free[1], np.asarray(np.linalg.cholesky(covariance), float))


# The two kinds of evidence, and how each imagines a view.
CANDIDATES: dict[type, Callable[[Any, Score, Score], CandidateViews | None]] = {
    PoseEvidence: candidate_poses,
    TargetEvidence: candidate_targets,
}


def nearby(measurement: Measurement) -> Array:
    """(K, n) joint angles near those that were driven, within the limits that were kept."""
    rng = np.random.default_rng(0)
    seen = measurement.views.joints
    joints = seen[rng.integers(0, len(seen), _SAMPLES)] + rng.uniform(-_SPREAD, _SPREAD, (_SAMPLES, seen.shape[1]))
    limit = np.maximum(_LIMIT, np.abs(seen).max(axis=0))
    return np.asarray(joints[(np.abs(joints) < limit).all(axis=1)])


def _rows(evidence: PoseEvidence, measurement: Measurement, scored: Score) -> Array:
    """(K, 6, p) twists of imagined views per unit of the form's free parameters."""
    term = with_values(scored.form, np.zeros(len(scored.values)))
    found = twists(measurement, (), term, evidence.T_mount, evidence.freed.overlaps.gram.centre)
    return np.asarray(found[scored.form.keep].transpose(1, 2, 0))


def _reachable(evidence: PoseEvidence) -> Array:
    """(K, n) joint angles in which the scanner sees the part about as it has before."""
    measurement = evidence.measurement
    assert measurement.robot is not None
    joints = nearby(measurement)
    T = kinematics.forward(measurement.robot, joints)
    poses = (frames.inverse(T) if measurement.eye_to_hand else T) @ evidence.T_mount
    centre = evidence.freed.overlaps.gram.centre[None]
    place = frames.transform(frames.inverse(poses), centre)[:, 0]
    before = frames.transform(frames.inverse(evidence.capture.poses(evidence.T_mount)), centre)[:, 0]
    margin = 0.15 * np.linalg.norm(before, axis=1).mean()
    inside = ((place > before.min(axis=0) - margin) & (place < before.max(axis=0) + margin)).all(axis=1)
    # A view direction far from all others would share no surface with them.
    towards, known = poses[:, :3, 2], evidence.capture.poses(evidence.T_mount)[:, :3, 2]
    inside &= (towards @ known.T).max(axis=1) > np.cos(np.radians(50.0))
    return np.asarray(joints[inside][:_TRIED])


def candidate_measurement(measurement: Measurement, joints: Array) -> Measurement:
    """The chain with views that nobody has taken yet, right after the last one, each approached from there."""
    assert measurement.robot is not None
    views, count = measurement.views, len(joints)
    last = np.repeat(views.joints[-1:], count, axis=0)
    torques = torques_of(measurement.robot, np.vstack([joints, views.joints]))
    pause = float(np.median(np.diff(views.time))) if views.has("time") and views.count > 1 else 0.0
    candidate = replace(
        views, count=count, joints=joints, previous=last, approach=np.sign(joints - last),
        # They would be taken at rest.
        time=np.full(count, views.time[-1] + pause), velocity=None if views.velocity is None else np.zeros_like(joints),
        torques=replace(torques, values=torques.values[:count]),
        covariates={name: np.full(count, values[-1]) for name, values in views.covariates.items()},
        number=np.full(count, views.number[-1] + 1),
    )  # fmt: skip
    return replace(
        measurement, views=candidate, T_base_flange=kinematics.forward(measurement.robot, joints), scan_views=()
    )


def _view_scatter(evidence: PoseEvidence, measurement: Measurement) -> Array:
    """(K, 6, 6) Cholesky factors of the pose scatter of one view about the centre."""
    to_centre = frames.make(np.eye(3), -evidence.freed.overlaps.gram.centre)
    T = (
        np.broadcast_to(np.eye(4), measurement.T_base_flange.shape)
        if measurement.eye_to_hand
        else measurement.T_base_flange
    )
    carried = frames.adjoint(to_centre @ T)
    variances = np.repeat(np.maximum(evidence.null.variances[:2], 1e-300), 3)
    return np.asarray(np.linalg.cholesky(carried * variances @ carried.transpose(0, 2, 1)))
