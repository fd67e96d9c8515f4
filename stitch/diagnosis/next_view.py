"""What to measure next: the pose that separates two candidate effects best, or the artefact that does.

Two effects a and b are told apart by what of a's pattern b cannot imitate: λ = |y_a − best of b|² in units
of the scatter. A further view adds six rows to both patterns; among poses that the arm can take and in which
the scanner would see the part as it has before, the one that adds most to the two that stay most alike is proposed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from stitch import frames
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.score import Score
from stitch.diagnosis.sensitivity import alias_matrix
from stitch.diagnosis.thresholds import ALIAS_CORRELATION, SEPARATION_LAMBDA
from stitch.diagnosis.verdict import Evidence
from stitch.frames import Array, Indices
from stitch.measurement import robot as kinematics
from stitch.measurement.capture import Sightings, build_capture
from stitch.measurement.measurement import PAYLOAD, Measurement, Torques, Views, downwards, torques_of
from stitch.measurement.robot import Robot
from stitch.model.forward import moves_points, perturbed_frames, pose_derivatives
from stitch.model.model import Model, Term
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import SurfaceObservation
from stitch.observations.targets.rows import Landmarks, TargetRows, effect_rows, mixed_model_of_rows, target_rows
from stitch.observations.targets.target_model import TargetObservation
from stitch.statistics.reml import NOISE

# Labelled points of views that nobody has taken yet.


def candidate_rows(
    measurement: Measurement, seen: TargetRows, landmarks: Landmarks, variances: Array, terms: Sequence[Term]
) -> tuple[TargetRows, list[Array], Array]:
    """Rows of K views in which every target would be seen, how they answer to `terms`, and their covariance.

    Args:
        measurement: of the candidate views.
        seen: rows of the views that were taken.
        variances: (3,) of rotation scatter, translation scatter, factor on the sensor's noise.

    Returns:
        Rows, one (K, m, P) per term, and (K, m, m).
    """
    known = np.flatnonzero(np.isfinite(landmarks.positions).all(axis=1))
    measurement = _all_seen(measurement, seen, landmarks, known)
    undrawn = replace(landmarks, drawing=None, T_reference_part=None)
    rows = target_rows(measurement.capture, seen.T_mount, undrawn)
    unknown = np.zeros((*rows.residual.shape, landmarks.size - rows.landmarks.shape[2]))
    rows = replace(rows, landmarks=np.concatenate([rows.landmarks, unknown], axis=2))
    covariance = mixed_model_of_rows(rows, rows.hand_eye).covariance(variances)
    return rows, effect_rows(rows, measurement, Model(seen.T_mount), terms), covariance


def _all_seen(measurement: Measurement, seen: TargetRows, landmarks: Landmarks, known: Indices) -> Measurement:
    """The measurement with sightings of all known targets, as good as those that were seen."""
    before, K = seen.sightings, len(measurement.T_base_flange)
    bare = build_capture("candidates", (), measurement.T_base_flange, measurement.mount)
    back = frames.inverse(bare.poses(seen.T_mount))
    points = frames.transform(back, landmarks.positions[known])
    sightings = Sightings(
        targets=before.targets,
        target=np.tile(known, (K, 1)),
        points=points,
        sigma=np.full(points.shape[:2], np.median(before.sigma[before.used])),
        used=np.ones(points.shape[:2], bool),
    )
    if before.sigma_rotation is not None and landmarks.orientation is not None:
        sigma_rotation = np.full(K, np.median(before.sigma_rotation))
        rotation = back[:, :3, :3] @ landmarks.orientation
        sightings = replace(sightings, rotation=rotation, sigma_rotation=sigma_rotation)
    down = downwards(measurement.robot, measurement.T_base_flange, measurement.eye_to_hand)
    first = measurement.target_views[0]
    usual = None if first.intensity is None else np.zeros(len(known))
    like = replace(first, views=measurement.views, cosine=np.ones(len(known)), intensity=usual)
    views = tuple(replace(like, index=v, gravity=down[v]) for v in range(K))
    return replace(measurement, capture=replace(bare, sightings=sightings), target_views=views)


# Views that nobody has taken yet, and how they would answer to a model and to two candidate effects.

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


ARTEFACTS = {
    "range_scale": "scan a sphere or ball bar of known size, or the part's CAD: overlaps alone hardly show a scale",
    "range_nonlinearity": "scan one patch at three distances, near, at the standoff and far",
    "incidence_bias": "scan one patch straight and at 60° from the same distance",
    "intensity_bias": "scan a flat plate with a black and a white half",
    "field_curvature": "scan a flat plate that fills the field, then the same turned by 180° about the view axis",
    "lens_distortion": "repeat a view with the scanner or the part turned by 180° about the view axis",
    "scanner_thermal_scale": "repeat the first view once the scanner is warm, and again after it has cooled",
    "latency": "repeat a sweep at half the speed and in the other direction",
    "mount_drift": "repeat the first views at the end without a pause",
    "mount_warmup": "repeat one view every two minutes after switching on",
    "joint_compliance": "repeat three views with another payload",
    "backlash": "repeat three views approached from the other side of every joint",
    "settling": "repeat three views after waiting five seconds before the scan",
    "robot_thermal_growth": "repeat the first views once the arm is warm",
    "fixture_drift": "clamp the part anew and repeat the first views at the end",
    "part_growth": "repeat a view of the part at another temperature, with the cell unchanged",
    "part_sag": "repeat two views with the part hanging the other way",
    "part_slip": "repeat the first view now",
}


@dataclass(frozen=True)
class Proposal:
    """One measurement."""

    do: str  # plain words
    separates: tuple[str, ...]
    joints_deg: list[float] | None = None
    views: int | None = None  # how many such views are needed


def propose_measurements(linear: LinearModel, evidence: Evidence) -> list[Proposal]:
    """What would tell the named group apart; without a group, the clearest candidate from what resembles it."""
    group = _effects_to_separate(linear, evidence)
    names = tuple(score.name for score in group)
    artefacts = [Proposal(ARTEFACTS[name], names) for name in names if name in ARTEFACTS]
    found = _best_pose(linear, group) if _can_move(linear.measurement) else None
    if found is None:
        return artefacts
    joints, count, separated = found
    told = ", ".join(f"j{i + 1} {x:.0f}°" for i, x in enumerate(joints))
    times = "a view" if count == 1 else f"{count} views"
    pose = Proposal(f"take {times} near {told}", separated, [round(float(x), 2) for x in joints], count)
    return [pose, *artefacts]


def _effects_to_separate(linear: LinearModel, evidence: Evidence) -> list[Score]:
    """What to separate: the group that was named, or the best candidate and its nearest alias; else nothing."""
    if len(evidence.named) > 1:
        return [r.score for r in evidence.named]
    seen = [r for r in evidence.ranked if r.score.observable and r.score.fitted][:6]
    if evidence.verdict == "adequate" or len(seen) < 2:
        return []
    first: Ranked = evidence.named[0] if evidence.named else seen[0]
    others = [r.score for r in seen if r.name != first.name]
    row = alias_matrix(linear, [first.score, *others])[0, 1:]
    return [first.score, others[int(row.argmax())]] if row.max() > ALIAS_CORRELATION else []


def _can_move(measurement: Measurement) -> bool:
    return measurement.robot is not None and measurement.views.joints.shape[1] > 0


def _best_pose(linear: LinearModel, group: list[Score]) -> tuple[Array, int, tuple[str, ...]] | None:
    """Joint angles (n,) in degrees where the two that stay most alike gain most, the number of such views, and what
    they separate; None if poses cannot separate anything.
    """
    pairs = [(gains, (a.name, b.name)) for a, b in combinations(group, 2) if (gains := _gains(linear, a, b))]
    pairs = [(gains, names) for gains, names in pairs if gains.of_views.max() > 1e-3 * SEPARATION_LAMBDA]
    if not pairs:
        return None
    k = int(np.min([gains.of_views for gains, _ in pairs], axis=0).argmax())
    counts = [np.ceil(max(SEPARATION_LAMBDA - g.known, 0.0) / max(g.of_views[k], 1e-12)) for g, _ in pairs]
    separated = dict.fromkeys(score.name for score in group if any(score.name in names for _, names in pairs))
    return np.degrees(pairs[0][0].joints[k]), int(np.clip(max(counts), 1, 99)), tuple(separated)


@dataclass(frozen=True)
class _Gains:
    """How much apart two candidate effects are, and how much each of K views would add to it."""

    known: float
    joints: Array  # (K, n) rad, the same for every two candidate effects
    of_views: Array  # (K,)


def _gains(linear: LinearModel, a: Score, b: Score) -> _Gains | None:
    """None if poses cannot show the effects."""
    candidate = candidate_views(linear, a, b)
    if candidate is None or not len(candidate.joints):
        return None
    # What is known already, as normal equations of [hand-eye and model | b] against a's pattern.
    X = np.hstack([linear.white_design, linear.whiten(b.form.columns) * b.form.sizes])
    y = linear.whiten(a.form.columns) @ a.values
    ridge = np.diag(np.concatenate([np.zeros(linear.white_design.shape[1]), np.full(len(b.form.sizes), 0.01)]))
    M, c, square = X.T @ X + ridge, X.T @ y, float(y @ y)
    known = square - float(c @ np.linalg.lstsq(M, c, rcond=1e-12)[0])
    gains = []
    for k in range(len(candidate.joints)):
        base = np.hstack([candidate.design[k], candidate.b[k] * b.form.sizes])
        Xn, yn = (np.linalg.solve(candidate.half[k], v) for v in (base, candidate.a[k] @ a.values))
        cn = c + Xn.T @ yn
        gains.append(square + float(yn @ yn) - float(cn @ np.linalg.lstsq(M + Xn.T @ Xn, cn, rcond=1e-12)[0]) - known)
    return _Gains(known, candidate.joints, np.array(gains))
