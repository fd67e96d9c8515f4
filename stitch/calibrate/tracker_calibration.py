"""Base and tool from measured poses: a tracker and its 6D probe, or a camera and its board.

Probe on the flange, sensor in the cell (eye_to_hand): T_base_flange · T_flange_probe =
T_base_sensor · T_sensor_probe. Camera on the flange, board in the cell (eye_in_hand):
T_base_flange · T_flange_camera = T_base_board · T_camera_board⁻¹. Both are A·X = Z·B.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.cluster.vq import kmeans2

from stitch import frames
from stitch.calibrate.hand_eye_refinement import AxzbSolution, refine_axzb
from stitch.calibrate.hand_eye_report import hand_eye_document, weak_components, weak_notes
from stitch.closed_form.axxb import park_martin
from stitch.closed_form.axzb import shah
from stitch.errors import NoResultError
from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.reading.frames_csv import MeasuredFrames, read_frames

# Second opinions further off than this many sigmas speak against independent errors.
_SURE = 3.0
# Rotations (rad) that scatter more than this do not belong to one base and tool.
_UNRELATED = 0.3
# Enough places for a spread among them, enough views in each to lose it without loss of rank.
_PLACES, _VIEWS_PER_PLACE = 25, 6


@dataclass(frozen=True)
class TrackerCalibration:
    """X (on the flange), Z (in the base) and what is left."""

    fit: AxzbSolution  # transforms (X, Z)
    views: tuple[str, ...]
    A: Array  # (V, 4, 4)
    B: Array  # (V, 4, 4)
    mount: str

    @property
    def hand_eye(self) -> int:
        """Which of the transforms is the sensor's: 1 (Z) with the sensor in the cell, 0 (X) on the flange."""
        return int(self.mount == "eye_to_hand")

    def covariance_of(self, k: int) -> Array:
        """(6, 6) of the right perturbation of X (0) or Z (1)."""
        return self.fit.covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]


def calibrate_tracker(session: Session) -> TrackerCalibration:
    """Base and tool of a frames session.

    Raises:
        InputError: frames.csv missing or broken.
        NoResultError: poses that cannot show both, or poses and frames that belong to different motions.
    """
    measured = read_frames(session.path / "frames.csv", session.names)
    flange = {view.name: view.T_base_flange for view in session.views}
    A = np.array([flange[name] for name in measured.views])
    eye_to_hand = session.mount == "eye_to_hand"
    B = measured.T_sensor_probe if eye_to_hand else frames.inverse(measured.T_sensor_probe)
    fit = refine_axzb(A, B, weights=_pose_weights(measured), robust=True, groups=_neighbourhoods(A))
    if fit.sigma[0] > _UNRELATED:
        raise NoResultError(
            f"flange poses and frames.csv do not fit together (rotations scatter by {np.degrees(fit.sigma[0]):.0f}°); "
            f"check the mount ({session.mount}), the order of the views, and the quaternions"
        )
    return TrackerCalibration(fit, measured.views, A, B, session.mount)


def _neighbourhoods(A: Array) -> Array | None:
    """Labels (V,) of places in the workspace: what base and tool do not explain errs alike in one place."""
    if len(A) < _VIEWS_PER_PLACE * _PLACES:
        return None
    return np.asarray(kmeans2(A[:, :3, 3], _PLACES, minit="++", rng=0)[1])


def _pose_weights(measured: MeasuredFrames) -> Array | None:
    if measured.sigma is None:
        return None
    return np.asarray((np.median(measured.sigma) / measured.sigma) ** 2)


def tracker_document(result: TrackerCalibration, session: Session) -> dict[str, Any]:
    """The JSON document."""
    fit, h = result.fit, result.hand_eye
    sigma = np.sqrt(np.diag(result.covariance_of(1 - h)))
    other = {
        "name": ("T_base_board", "T_flange_probe")[h],
        "transform": fit.transforms[1 - h].tolist(),
        "sigma": sigma.tolist(),
    }
    return {
        **hand_eye_document("tracker", session, fit.transforms[h], result.covariance_of(h), fit.inflation, result.A),
        "other": other,
        "views": len(result.views),
        "position_error": _error_sizes(fit.residual[:, 3:]),
        "rotation_error_deg": _error_sizes(np.degrees(fit.residual[:, :3])),
        "heldout_position_error": _error_sizes(fit.heldout[:, 3:]),
        "heldout_rotation_error_deg": _error_sizes(np.degrees(fit.heldout[:, :3])),
        "scatter": {"rotation": fit.sigma[0], "translation": fit.sigma[1]},
        "closed_forms": compare_closed_forms(result),
        "weak": _weak_phrases(result, session.length_unit),
        "notes": tracker_notes(result, session),
    }


def _error_sizes(errors: Array) -> dict[str, float]:
    length = np.linalg.norm(errors, axis=1)
    return {"mean": float(length.mean()), "rms": float(np.sqrt(np.mean(length**2))), "max": float(length.max())}


def _weak_phrases(result: TrackerCalibration, unit: str) -> list[str]:
    lever = float(np.median(np.linalg.norm(result.B[:, :3, 3], axis=1)))
    return weak_components(result.covariance_of(result.hand_eye), result.fit.sigma[1], lever, unit)


def compare_closed_forms(result: TrackerCalibration) -> dict[str, dict[str, float]]:
    """How far X of the closed forms is from the refined one: second opinions of other errors."""
    half = len(result.A) // 2
    A = frames.inverse(result.A[:half]) @ result.A[half : 2 * half]
    B = frames.inverse(result.B[:half]) @ result.B[half : 2 * half]
    out = {}
    for name, X in (("Shah (A·X = Z·B)", shah(result.A, result.B)[0]), ("Park-Martin (A·X = X·B)", park_martin(A, B))):
        off = frames.log(frames.inverse(result.fit.transforms[0]) @ X)
        size = np.linalg.norm(off.reshape(2, 3), axis=1)
        out[name] = {"rotation_deg": float(np.degrees(size[0])), "translation": float(size[1])}
    return out


def tracker_notes(result: TrackerCalibration, session: Session) -> list[str]:
    """Sentences about the wrist, weak components, and errors that base and tool do not explain."""
    unit, fit = session.length_unit, result.fit
    notes = weak_notes(result.A, _weak_phrases(result, unit))
    position, noise = _error_sizes(fit.heldout[:, 3:])["mean"], session.scanner.noise
    if noise is not None and position > _SURE * np.sqrt(3) * noise:
        notes.append(
            f"Base and tool alone leave {position:#.3g} {unit} in the position of views left out (mean), "
            f"{position / noise:.0f} times the sensor's noise of {noise:g}: the rest is the robot's own"
        )
    if fit.inflation > 2:
        notes.append(
            f"Views near each other err alike: the covariance, counted in places, is {fit.inflation:.0f} times that of "
            "independent views"
        )
    return notes
