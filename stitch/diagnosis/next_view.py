"""What to measure next: the pose that separates two candidate effects best, or the artefact that does.

Two effects a and b are told apart by what of a's pattern b cannot imitate: λ = |y_a − best of b|² in units
of the scatter. A further view adds six rows to both patterns; among poses that the arm can take and in which
the scanner would see the part as it has before, the one that adds most to the two that stay most alike is proposed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stitch.diagnosis.candidate_views import candidate_measurement, candidate_rows, nearby, reachable
from stitch.diagnosis.diagnosis import Diagnosis, Proposal
from stitch.diagnosis.score import Score
from stitch.diagnosis.sensitivity import alias_matrix
from stitch.diagnosis.thresholds import ALIAS_CORRELATION, SEPARATION_LAMBDA, WORTHWHILE_GAIN
from stitch.model.forward import moves_points, perturbed_frames, pose_derivatives
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import equilibrated
from stitch.numerics.reml import NOISE
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import SurfaceObservation
from stitch.observations.targets.rows import TargetRows
from stitch.session.capture import build_capture
from stitch.session.robot import forward
from stitch.system.threads import library_threads_off

# Poses that are tried; and the likeliest candidates among which an alias of the best is sought.
_TRIED, _LIKELIEST = 250, 6
# Precision of ten plausible sizes: a rival may take each of its parameters that large.
RIDGE = 0.01

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
    "mount_droop": "repeat a view with the flange turned by 180° about its axis",
    "fixture_droop": "repeat a view with the part hanging the other way",
    "fixture_drift": "clamp the part anew and repeat the first views at the end",
    "part_growth": "repeat a view of the part at another temperature, with the cell unchanged",
    "part_sag": "repeat two views with the part hanging the other way",
    "part_slip": "repeat the first view now",
}


def propose_measurements(diagnosis: Diagnosis) -> tuple[Proposal, ...]:
    """Return what would tell the named group apart; without a group, the clearest candidate from what resembles it."""
    with library_threads_off():
        linear = diagnosis.linear
        group = _effects_to_separate(diagnosis)
        names = tuple(scored.name for scored in group)
        artefacts = tuple(Proposal(ARTEFACTS[name], names) for name in names if name in ARTEFACTS)
        can_move = linear.measurement.robot is not None and linear.measurement.views.joints.shape[1] > 0
        best = _best_pose(linear, group) if can_move else None
        if best is None:
            return artefacts
        joints, count, separated = best
        angles = ", ".join(f"j{i + 1} {x:.0f}°" for i, x in enumerate(joints))
        times = "a view" if count == 1 else f"{count} views"
        pose = Proposal(f"take {times} near {angles}", separated, [round(float(x), 2) for x in joints], count)
        return (pose, *artefacts)


def _effects_to_separate(diagnosis: Diagnosis) -> list[Score]:
    """Return the group that was named, or the best candidate and its nearest alias; else nothing."""
    if len(diagnosis.named) > 1:
        return [r.score for r in diagnosis.named]
    fitted = [c.ranked for c in diagnosis.candidates if c.ranked.score.observable and c.ranked.score.fitted]
    likeliest = fitted[:_LIKELIEST]
    if diagnosis.verdict == "adequate" or len(likeliest) < 2:
        return []
    first = diagnosis.named[0] if diagnosis.named else likeliest[0]
    others = [r.score for r in likeliest if r.name != first.name]
    row = alias_matrix(diagnosis.linear, [first.score, *others])[0, 1:]
    return [first.score, others[int(row.argmax())]] if row.max() > ALIAS_CORRELATION else []


def _best_pose(linear: LinearModel, group: Sequence[Score]) -> tuple[Array, int, tuple[str, ...]] | None:
    """Return joint angles (n,) in degrees where the two that stay most alike gain most, the number of such views, and
    what they separate; None if poses cannot separate anything.
    """
    joints = None
    separable = []
    for a, b in combinations(group, 2):
        gains = _gains(linear, a, b)
        if gains is not None and gains[2].max() > WORTHWHILE_GAIN * SEPARATION_LAMBDA:
            joints, known, of_views = gains  # the joints are the same for every two candidate effects
            separable.append((known, of_views, (a.name, b.name)))
    if joints is None:
        return None
    k = int(np.min([of_views for _, of_views, _ in separable], axis=0).argmax())
    counts = [np.ceil(max(SEPARATION_LAMBDA - known, 0.0) / max(gains[k], 1e-12)) for known, gains, _ in separable]
    separated = dict.fromkeys(scored.name for scored in group if any(scored.name in names for *_, names in separable))
    return np.degrees(joints[k]), int(np.clip(max(counts), 1, 99)), tuple(separated)


def _gains(linear: LinearModel, a: Score, b: Score) -> tuple[Array, float, Array] | None:
    """Return joints (K, n) of candidate views, how much apart two candidate effects are, and how much each view would
    add to that (K,); None if poses cannot show the effects."""
    views = candidate_views(linear, a, b)
    if views is None or not len(views.joints):
        return None
    # Columns of hand-eye and model, of b at plausible sizes, and the pattern of a.
    pattern = linear.whiten(a.form.columns) @ a.values
    known = np.column_stack([linear.white_design, linear.whiten(b.form.columns) * b.form.sizes, pattern])
    further = np.concatenate([views.design, views.b * b.form.sizes, (views.a @ a.values)[..., None]], axis=2)
    white = np.linalg.solve(views.half, further)
    present = known.T @ known
    q = known.shape[1]
    of_b = slice(linear.white_design.shape[1], q - 1)
    of_a = slice(q - 1, q)
    apart = float(separations(present, of_a, of_b)[0])
    with_each = separations(present + white.transpose(0, 2, 1) @ white, of_a, of_b)[:, 0]
    return views.joints, apart, with_each - apart


def separations(normal: Array, own: slice, rival: slice) -> Array:
    """Return (..., p) squared length of what every column of a pattern keeps when a rival's imitate it, all else being
    free.

    Args:
        normal: (..., q, q) normal matrix; columns at plausible sizes.
        own: of the pattern.
        rival: of the rival.
    """
    q = normal.shape[-1]
    rest = np.setdiff1d(np.arange(q), np.arange(own.start, own.stop))
    ridge = np.where((rest >= rival.start) & (rest < rival.stop), RIDGE, 0.0)
    free = normal[..., rest[:, None], rest] + np.diag(ridge)
    across = normal[..., rest[:, None], np.arange(own.start, own.stop)]
    same_units, unit = equilibrated(free)
    inverse = np.linalg.pinv(same_units, rcond=1e-12, hermitian=True)
    scaled = across * unit[..., :, None]
    imitated = np.einsum("...ap,...ab,...bp->...p", scaled, inverse, scaled)
    left = np.diagonal(normal[..., own, own], axis1=-2, axis2=-1) - imitated
    return np.maximum(left, 0.0)


@dataclass(frozen=True)
class CandidateViews:
    """How K views that could be taken would answer to a model and to two effects, m numbers each, before whitening."""

    joints: Array  # (K, n) rad
    design: Array  # (K, m, a) per column of the model
    a: Array  # (K, m, p) per free parameter of one effect
    b: Array  # (K, m, q) of the other
    half: Array  # (K, m, m) Cholesky factors of the scatter of one view


def candidate_views(linear: LinearModel, a: Score, b: Score) -> CandidateViews | None:
    """Return further views of a session for two effects; None if no pose can show them, and for an observation of which
    nobody says how it would look in a further view."""
    match linear.observation:
        case SurfaceObservation() as surfaces:
            return _of_surfaces(linear, surfaces, a, b)
        case TargetRows() as targets:
            return _of_targets(linear, targets, a, b)
    return None


def _of_surfaces(linear: LinearModel, surfaces: SurfaceObservation, a: Score, b: Score) -> CandidateViews | None:
    """Return poses in which the scanner would see the part about as it has before; None if poses cannot show the
    effects."""
    T_mount = linear.model.T_mount

    def poses_of(joints: Array) -> Array:
        assert linear.measurement.robot is not None
        T = forward(linear.measurement.robot, joints)
        return build_capture("candidates", (), T, linear.measurement.mount).poses(T_mount)

    driven = linear.measurement.views.joints
    joints = reachable(driven, poses_of, surfaces.capture.poses(T_mount), surfaces.centre)[:_TRIED]
    if moves_points([scored.form.term for scored in (a, b)]) or not len(joints):
        return None
    return surface_views_at(linear, surfaces, joints, a, b)


def surface_views_at(
    linear: LinearModel, surfaces: SurfaceObservation, joints: Array, a: Score, b: Score
) -> CandidateViews:
    """Return further views of surfaces at joint angles (K, n) for two effects of poses: six numbers a view, its
    twist."""
    zero = [scored.form.at(np.zeros(len(scored.values))) for scored in (a, b)]
    centre = surfaces.centre
    measurement = candidate_measurement(linear.measurement, joints)
    bare = Model(linear.model.T_mount)
    to_centre = frames.make(np.eye(3), -centre)
    hand_eye = frames.adjoint(to_centre @ (perturbed_frames(measurement, ())[0] @ bare.T_mount))
    extra = np.zeros((len(joints), 6, linear.white_design.shape[1] - 6))
    derivatives = pose_derivatives(measurement, bare, zero, centre)
    of_a, of_b = (
        twists[scored.form.keep].transpose(1, 2, 0) for twists, scored in zip(derivatives, (a, b), strict=True)
    )
    # The pose scatter of one view about the centre.
    T = measurement.T_base_flange
    carried = frames.adjoint(to_centre @ (np.broadcast_to(np.eye(4), T.shape) if measurement.eye_to_hand else T))
    variances = np.repeat(np.maximum(linear.flange_scatter(linear.null), 1e-300), 3)
    half = np.linalg.cholesky(carried * variances @ carried.transpose(0, 2, 1))
    return CandidateViews(joints, np.concatenate([hand_eye, extra], axis=2), of_a, of_b, half)


def _of_targets(linear: LinearModel, targets: TargetRows, a: Score, b: Score) -> CandidateViews:
    """Return poses near those driven, in which all targets are seen."""
    joints = nearby(linear.measurement.views.joints)[:_TRIED]
    measurement = candidate_measurement(linear.measurement, joints)
    zero = [scored.form.at(np.zeros(len(scored.values))) for scored in (a, b)]
    flange_and_noise = np.append(linear.flange_scatter(linear.null), linear.null.variances[NOISE])
    rows, columns, covariance = candidate_rows(measurement, targets, targets.places, flange_and_noise, zero)
    extra = np.zeros((*rows.residual.shape, linear.design.shape[1] - 6 - rows.landmarks.shape[2]))
    design = np.concatenate([rows.hand_eye, rows.landmarks, extra], axis=2)
    of_a, of_b = (c[..., scored.form.keep] for c, scored in zip(columns, (a, b), strict=True))
    half = np.asarray(np.linalg.cholesky(covariance), float)
    return CandidateViews(joints, design, of_a, of_b, half)
