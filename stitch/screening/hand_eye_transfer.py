"""A given hand-eye against the one that a session's own views show.

Register moves each view to where the surfaces agree, so that the stitched cloud hardly answers to the hand-eye. The
views' free-network poses do: one generalised least-squares step from the given model leads to the hand-eye that these
views ask for, with all that arms and scanners repeat in its covariance.
"""

import numpy as np

from stitch.model.model import Model, displacement
from stitch.numerics import frames
from stitch.numerics.distributions import chi2_limit, chi2_tail
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import equilibrated
from stitch.observations.pose_errors import prior_pose_errors
from stitch.observations.surfaces.effect_columns import view_columns
from stitch.observations.surfaces.hand_eye_fit import hand_eye_statistics, solve_hand_eye
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses
from stitch.run_data import HandEyeTransfer
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement

# What another run's effects may still err by.
_EFFECTS = "effects of the model"


def hand_eye_transfer(
    measurement: Measurement, capture: Capture, unconstrained: UnconstrainedPoses, model: Model
) -> HandEyeTransfer:
    """Return how a given hand-eye differs from the one that a session's views show, with a χ² test and U of both.

    Args:
        capture: the session's, with the model's effects taken out.
        unconstrained: its views moved by their overlaps alone, and the twists from the model's poses there.
        model: the given hand-eye and effects, with their covariances.
    """
    T_mount = solve_hand_eye([capture], [unconstrained], model.T_mount).T_mount
    # Views that start far off have not converged, which would count as scatter: once more from there.
    unconstrained = unconstrained_poses(capture, capture.poses(T_mount), unconstrained.overlaps.gate)
    errors = rig_scanner_errors([measurement], [unconstrained])
    columns = view_columns(measurement, model, unconstrained)
    errors[_EFFECTS] = [columns @ model.effects_covariance.root(model.terms)]
    poses = prior_pose_errors([measurement], model, [unconstrained.overlaps.gram.centre])
    fitted = hand_eye_statistics(
        solve_hand_eye([capture], [unconstrained], T_mount, scanner_errors=errors), poses, errors
    )
    turn, distance = hand_eye_difference(capture, model.T_mount, fitted.T_mount)
    xi = frames.log(frames.inverse(model.T_mount) @ fitted.T_mount)
    part_centre = _part_centre(capture)
    covariance = model.covariance + fitted.covariance
    square = mahalanobis_square(xi, covariance)
    return HandEyeTransfer(
        turn=turn,
        distance=distance,
        ratio=float(np.sqrt(square / chi2_limit(0.05, 6))),
        U=displacement(covariance, part_centre),
        U_given=displacement(model.covariance, part_centre),
        p_value=chi2_tail(square, 6),
    )


def hand_eye_difference(capture: Capture, T_mount: Array, other: Array) -> tuple[float, float]:
    """Return the angle (rad) between two hand-eyes, and how far they put the middle of the part from each other."""
    xi = frames.log(frames.inverse(T_mount) @ other)
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:] + np.cross(xi[:3], _part_centre(capture))))


def mahalanobis_square(difference: Array, covariance: Array) -> float:
    """Return dᵀ C⁻¹ d of a difference d (n,); a direction that is known exactly counts nothing."""
    scaled, unit = equilibrated(covariance)
    return float((difference * unit) @ np.linalg.pinv(scaled, rcond=1e-9, hermitian=True) @ (difference * unit))


def _part_centre(capture: Capture) -> Array:
    """(3,) mean over the views of the centroids of their scans, scanner frame."""
    return np.mean([scan.points.mean(axis=0) for scan in capture.scans], axis=0)
