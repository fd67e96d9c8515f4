"""Labelled points as linear rows about a model: what is left, and how it answers to views and landmarks.

A view v with S slots has m = 3S rows x − P (reference frame), and three more for the turn of a probe. A left
twist δ of the view about `centre` moves them by lever·δ, the landmarks by their own columns. Nominal targets
are further blocks of three rows: the target less its place in the drawing.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array, Mask
from stitch.measurement.capture import Capture
from stitch.measurement.sightings import Sightings
from stitch.observations.targets.landmarks import Landmarks
from stitch.statistics.restricted_likelihood import MixedModel


@dataclass(frozen=True)
class TargetRows:
    """V views, B ≥ V blocks of m rows; U unknowns of the landmarks."""

    capture: Capture  # without the effects in use
    T_mount: Array  # (4, 4)
    centre: Array  # (3,) of the targets, reference frame
    residual: Array  # (B, m) where a view puts a target less where it is
    lever: Array  # (V, m, 6) rows per left twist of the view about the centre
    hand_eye: Array  # (B, m, 6) per right perturbation of the hand-eye
    landmarks: Array  # (B, m, U)
    noise: Array  # (B, m) variance of the sensor; 0 where a row is absent or none of the sensor's
    fixed: Array  # (B, m) variance that is known: 1 in absent rows, that of the drawing in its own
    positions: int  # the first 3S rows of a view are coordinates

    @property
    def sightings(self) -> Sightings:
        """The labelled points that the rows are of."""
        assert self.capture.sightings is not None
        return self.capture.sightings

    @property
    def used(self) -> Mask:
        """(V, m) bool: rows of the views that were measured."""
        return np.asarray(self.noise[: len(self.lever)] > 0)

    @property
    def reach(self) -> float:
        """Distance of the targets from the flange: what a turn of it moves them by."""
        away = np.linalg.norm(self.centre - self.capture.T_reference_flange[:, :3, 3], axis=1)
        return float(max(np.median(away), 1e-9))

    def from_twists(self, moved: Array) -> Array:
        """(B, m, P) of left twists (6V, P) of the views about the centre."""
        out = np.zeros((*self.residual.shape, moved.shape[1]))
        out[: len(self.lever)] = self.lever @ moved.reshape(-1, 6, moved.shape[1])
        return out

    def distances(self, left: Array) -> Array:
        """(V, S) 3D distances of rows (B, m) from zero; NaN where nothing was measured."""
        views = len(self.lever)
        d = np.linalg.norm(left[:views, : self.positions].reshape(views, -1, 3), axis=2)
        return np.where(self.used[:, : self.positions : 3], d, np.nan)


def target_rows(own: Capture, T_mount: Array, landmarks: Landmarks) -> TargetRows:
    """Linearise labelled points about hand-eye and landmarks.

    Args:
        own: without the effects in use.
    """
    s = own.sightings
    assert s is not None
    poses = own.poses(T_mount)
    centre = np.asarray(frames.transform(poses, s.points)[s.used].mean(axis=0))
    parts = [_coordinate_rows(s, poses, centre, landmarks)]
    if s.rotation is not None:
        parts.append(_orientation_rows(s, poses, landmarks))
    left, noise, lever, columns = (np.concatenate(blocks, axis=1) for blocks in zip(*parts, strict=True))
    absent = noise == 0
    left[absent], lever[absent], columns[absent] = 0.0, 0.0, 0.0
    of_drawing, moved_in_drawing, known = _drawing_rows(landmarks, left.shape[1])
    nothing = np.zeros_like(of_drawing)
    hand_eye = lever @ frames.adjoint(frames.make(np.eye(3), -centre) @ own.hand_eye_frames(T_mount))
    return TargetRows(
        capture=own,
        T_mount=T_mount,
        centre=centre,
        residual=np.concatenate([left, of_drawing]),
        lever=lever,
        hand_eye=np.concatenate([hand_eye, np.repeat(nothing[..., None], 6, axis=2)]),
        landmarks=np.concatenate([columns, moved_in_drawing]),
        noise=np.concatenate([noise, nothing]),
        fixed=np.concatenate([absent.astype(float), known]),
        positions=3 * s.used.shape[1],
    )


def _coordinate_rows(
    s: Sightings, poses: Array, centre: Array, landmarks: Landmarks
) -> tuple[Array, Array, Array, Array]:
    """What is left (V, 3S), its variance, (V, 3S, 6) per twist of the view and (V, 3S, U) per landmark."""
    V, S = s.used.shape
    known = np.nan_to_num(landmarks.positions)[np.maximum(s.target, 0)]
    left = (frames.transform(poses, s.points) - known).reshape(V, -1)
    noise = np.repeat(np.where(s.used, s.sigma**2, 0.0), 3, axis=1)
    # At the landmark, not where the view puts it: a turn of all views must look exactly as the same turn of the
    # landmarks does, or what is left would lend itself to parameters that nothing shows. The normal equations agree.
    turned = -frames.skew(known - centre).reshape(V, -1, 3)
    lever = np.concatenate([turned, np.tile(np.eye(3), (V, S, 1))], axis=2)
    columns = np.zeros((V, 3 * S, landmarks.size))
    v, slot = np.nonzero(s.used)
    for axis in range(3):
        columns[v, 3 * slot + axis, 3 * s.target[v, slot] + axis] = -1.0
    return left, noise, lever, columns


def _orientation_rows(s: Sightings, poses: Array, landmarks: Landmarks) -> tuple[Array, Array, Array, Array]:
    """The same of the three rows (rad) of a probe's turn; zeros where nobody knows how it is held."""
    V, at = len(poses), landmarks.positions.size
    left, noise, lever, columns = (np.zeros((V, 3, *more)) for more in ((), (), (6,), (landmarks.size,)))
    if s.rotation is None or s.sigma_rotation is None or landmarks.orientation is None:
        return left, noise, lever, columns
    left = Rotation.from_matrix(poses[:, :3, :3] @ s.rotation @ landmarks.orientation.T).as_rotvec()
    noise[:] = np.where(s.used.any(axis=1), s.sigma_rotation**2, 0.0)[:, None]
    lever[..., :3] = np.eye(3)
    columns[..., at : at + 3] = -np.eye(3)
    return left, noise, lever, columns


def _drawing_rows(landmarks: Landmarks, m: int) -> tuple[Array, Array, Array]:
    """Of D nominal targets less their places in the drawing: what is left (D, m), (D, m, U) per landmark, and the
    variance (D, m) that is known; three rows each, the others absent."""
    count = 0 if landmarks.drawing is None else len(landmarks.drawing.target)
    left, columns, fixed = np.zeros((count, m)), np.zeros((count, m, landmarks.size)), np.ones((count, m))
    if landmarks.drawing is None or landmarks.T_reference_part is None:
        return left, columns, fixed
    placed = frames.transform(landmarks.T_reference_part, landmarks.drawing.points)
    for t, (k, p) in enumerate(zip(landmarks.drawing.target, placed, strict=True)):
        left[t, :3] = landmarks.positions[k] - p
        columns[t, :3, 3 * k : 3 * k + 3] = np.eye(3)
        columns[t, :3, -6:] = np.hstack([frames.skew(p), -np.eye(3)])
        fixed[t, :3] = landmarks.drawing.sigma[t] ** 2
    return left, columns, fixed


def mixed_model_of_rows(rows: TargetRows, A: Array) -> MixedModel:
    """Rows as blocks for the variance components; `A` (B, m, a) are the columns of the free mean."""
    V, (B, m) = len(rows.lever), rows.residual.shape
    to_centre = frames.make(np.eye(3), -rows.centre)
    carried = rows.lever @ frames.adjoint(to_centre @ rows.capture.T_reference_flange)
    components = np.zeros((3, B, m, m))
    for i, half in enumerate((slice(0, 3), slice(3, 6))):
        components[i, :V] = carried[..., half] @ carried[..., half].transpose(0, 2, 1)
    diagonal = np.arange(m)
    components[2][:, diagonal, diagonal] = rows.noise
    fixed = np.zeros((B, m, m))
    fixed[:, diagonal, diagonal] = rows.fixed
    # A view errs in six ways, whatever it shows; what it shows beyond that, the landmarks take up.
    independent = int(np.minimum(rows.used.sum(axis=1), 6).sum()) + max(rows.landmarks.shape[2] - 6, 0)
    return MixedModel(-rows.residual, A, components, fixed, independent)
