"""Labelled points as linear rows about a model: what is left, and how it answers to views and landmarks.

A view v with S slots has m = 3S rows x − P (reference frame), and three more for the turn of a probe. A left
twist δ of the view about `centre` moves them by lever·δ, the landmarks by their own columns. Nominal targets
are further blocks of three rows: the target less its place in the drawing.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import BlockLeastSquares
from stitch.numerics.reml import fit_variances
from stitch.observations.rows import Rows
from stitch.session.capture import Capture, Sightings
from stitch.session.session import NominalTargets

# More targets hold each other, so that a wrong one pulls little; to compare all their pairs takes minutes.
COMPARED_TARGETS = 24


def target_positions(sightings: Sightings) -> Array:
    """Return the place (V, K, 3) of each of K targets in each view, sensor frame; NaN where a view does not show it."""
    places = np.full((len(sightings.target), len(sightings.targets), 3), np.nan)
    view, slot = np.nonzero(sightings.used)
    places[view, sightings.target[view, slot]] = sightings.points[view, slot]
    return places


def target_distances(places: Array) -> Array:
    """Return the distances (V, K, K) between targets at places (V, K, 3); NaN where a view does not show both."""
    return np.linalg.norm(places[:, :, None] - places[:, None], axis=3)


def distance_sigma(sightings: Sightings) -> float:
    """Return the sigma, length_unit, of a distance between two targets by the sensor's noise, from the median."""
    return float(np.sqrt(2) * np.median(sightings.sigma[sightings.used]))


@dataclass(frozen=True)
class Drawing:
    """Nominal targets among those seen: measurements of them in the part frame."""

    target: Indices  # (T,) number of the target
    points: Array  # (T, 3) part frame
    sigma: Array  # (T,)


@dataclass(frozen=True)
class Landmarks:
    """K targets in the reference frame; the U unknowns are 3K positions, 3 of a probe's turn, 6 of a drawing's pose."""

    positions: Array  # (K, 3)
    orientation: Array | None = None  # (3, 3) R_reference_probe
    drawing: Drawing | None = None
    T_reference_part: Array | None = None  # (4, 4) where the drawing lies

    @property
    def size(self) -> int:
        """Number U of unknowns."""
        return self.positions.size + 3 * (self.orientation is not None) + 6 * (self.drawing is not None)

    def updated(self, by: Array) -> "Landmarks":
        """Return the landmarks after a step of all their unknowns.

        Args:
            by: (U,) in this order: translations of the K targets (3K), length_unit; left rotation vector (3) of the
                probe, if there is one, rad; left twist (6) of the drawing, if there is one.
        """
        at = self.positions.size
        positions = self.positions + by[:at].reshape(-1, 3)
        orientation, T = self.orientation, self.T_reference_part
        if orientation is not None:
            orientation = Rotation.from_rotvec(by[at : at + 3]).as_matrix() @ orientation
            at += 3
        if T is not None:
            T = frames.exp(by[at : at + 6]) @ T
        return replace(self, positions=positions, orientation=orientation, T_reference_part=T)


def drawing_of(nominal: NominalTargets | None, sightings: Sightings) -> Drawing | None:
    """Return the nominal places, part frame, of those targets that are seen; None where there is no drawing.

    Where the drawing states no sigma, it is the median sigma of the sightings.
    """
    if nominal is None:
        return None
    names = sightings.targets
    usual = float(np.median(sightings.sigma[sightings.used]))
    pairs = [(names.index(name), i) for i, name in enumerate(nominal.targets) if name in names]
    target, rows = (np.array(column) for column in zip(*pairs, strict=True))
    sigma = nominal.sigma[rows]
    return Drawing(target, nominal.points[rows], np.where(np.isnan(sigma), usual, sigma))


def initial_landmarks(capture: Capture, T_mount: Array, drawing: Drawing | None = None) -> Landmarks:
    """Return the landmarks at the median of where the views put them under a hand-eye; NaN for one that is not seen.

    Positions are in the reference frame. The orientation of a probe is a median of rotation vectors, T_reference_part
    the best fit of the drawing to the positions.

    Args:
        capture: with the effects in use taken out.
        T_mount: (4, 4) maps sensor to mount.
        drawing: nominal places of targets; None: none are known.
    """
    s = capture.sightings
    assert s is not None
    poses = capture.poses(T_mount)
    placed = frames.transform(poses, s.points)
    positions = np.full((len(s.targets), 3), np.nan)
    for k in range(len(s.targets)):
        of_target = placed[s.used & (s.target == k)]
        if len(of_target):
            positions[k] = np.median(of_target, axis=0)
    orientation = None
    if s.rotation is not None:
        R_reference_probe = (poses[:, :3, :3] @ s.rotation)[s.used.any(axis=1)]
        first = frames.nearest_rotation(np.median(R_reference_probe, axis=0))
        # The median of matrices is no rotation and is biased; that of rotation vectors from it is neither.
        deviations = Rotation.from_matrix(R_reference_probe @ first.T).as_rotvec()
        orientation = Rotation.from_rotvec(np.median(deviations, axis=0)).as_matrix() @ first
    if drawing is None:
        return Landmarks(positions, orientation)
    seen = np.isfinite(positions[drawing.target]).all(axis=1)
    T = align_points(drawing.points[seen], positions[drawing.target[seen]])
    return Landmarks(positions, orientation, drawing, T)


@dataclass(frozen=True, kw_only=True)
class TargetRows(Rows):
    """Rows of labelled points: 3S coordinates of S slots a view, of a probe its turn too; then rows of a drawing."""

    variance: Array  # (B, m) known variance: 1 in absent rows, that of the drawing in its rows
    positions: int  # the first 3S rows of a view are coordinates
    places: Landmarks  # about which the rows are linearised

    @property
    def fixed(self) -> Array:
        """(B, m) known variance of each row: see `variance`."""
        return self.variance

    @property
    def sightings(self) -> Sightings:
        """The labelled points that the rows are of."""
        assert self.capture.sightings is not None
        return self.capture.sightings

    @cached_property
    def distances_used(self) -> Mask:
        """(V, m) mask of the coordinates that were measured; a probe's turn is no length."""
        return self.used & (np.arange(self.residual.shape[1]) < self.positions)

    def point_rows(self, moved: Array) -> Array:
        """Return the change (P, V, m) of the rows where points move by (P, V, S, 3); a probe's turn stays."""
        out = np.zeros((*moved.shape[:2], self.residual.shape[1]))
        out[..., : self.positions] = moved.reshape(*moved.shape[:2], -1)
        return out

    def distances(self, left: Array) -> Array:
        """Return 3D distances (V, S) from zero, of the coordinates in rows (B, m); NaN where nothing was measured.

        Args:
            left: residuals of the rows.
        """
        views = len(self.lever)
        d = np.linalg.norm(left[:views, : self.positions].reshape(views, -1, 3), axis=2)
        return np.where(self.used[:, : self.positions : 3], d, np.nan)


def target_rows(capture: Capture, T_mount: Array, landmarks: Landmarks) -> TargetRows:
    """Return the rows of labelled points, linearised about hand-eye and landmarks.

    Rows are coordinates (length_unit) and, of a probe, orientations (rad); `noise` is in their squares. A row that a
    view does not show has noise 0, so that it counts nothing, and variance 1, so that its block has an inverse.

    Args:
        capture: with the effects in use taken out.
        T_mount: (4, 4) maps sensor to mount.
    """
    s = capture.sightings
    assert s is not None
    poses = capture.poses(T_mount)
    centre = np.asarray(frames.transform(poses, s.points)[s.used].mean(axis=0))
    parts = [_coordinate_rows(s, poses, centre, landmarks)]
    if s.rotation is not None:
        parts.append(_orientation_rows(s, poses, landmarks))
    residual, noise, lever, columns = (np.concatenate(blocks, axis=1) for blocks in zip(*parts, strict=True))
    absent = noise == 0
    residual[absent], lever[absent], columns[absent] = 0.0, 0.0, 0.0
    drawing_residual, drawing_columns, drawing_variance = _drawing_rows(landmarks, residual.shape[1])
    return TargetRows(
        capture=capture,
        T_mount=T_mount,
        centre=centre,
        residual=np.concatenate([residual, drawing_residual]),
        lever=lever,
        landmarks=np.concatenate([columns, drawing_columns]),
        noise=np.concatenate([noise, np.zeros_like(drawing_residual)]),
        variance=np.concatenate([absent.astype(float), drawing_variance]),
        positions=3 * s.used.shape[1],
        places=landmarks,
    )


def _coordinate_rows(
    s: Sightings, poses: Array, centre: Array, landmarks: Landmarks
) -> tuple[Array, Array, Array, Array]:
    """Return the rows of the coordinates of S targets in V views, linearised about hand-eye and landmarks.

    Returns:
        Residual (V, 3S) and its variance, length_unit and its square; its change (V, 3S, 6) per left twist of the view
        about the centre, and (V, 3S, U) per unknown of the landmarks. Zeros where a view does not show a target.
    """
    V, S = s.used.shape
    places = np.nan_to_num(landmarks.positions)[np.maximum(s.target, 0)]
    residual = (frames.transform(poses, s.points) - places).reshape(V, -1)
    noise = np.repeat(np.where(s.used, s.sigma**2, 0.0), 3, axis=1)
    # At the landmark, not where the view puts it: a turn of all views must look exactly as the same turn of the
    # landmarks does, or what is left would lend itself to parameters that nothing shows. The normal equations agree.
    per_rotation = -frames.skew(places - centre).reshape(V, -1, 3)
    lever = np.concatenate([per_rotation, np.tile(np.eye(3), (V, S, 1))], axis=2)
    columns = np.zeros((V, 3 * S, landmarks.size))
    v, slot = np.nonzero(s.used)
    for axis in range(3):
        columns[v, 3 * slot + axis, 3 * s.target[v, slot] + axis] = -1.0
    return residual, noise, lever, columns


def _orientation_rows(s: Sightings, poses: Array, landmarks: Landmarks) -> tuple[Array, Array, Array, Array]:
    """Return the three rows (rad) of a probe's turn in V views, as `_coordinate_rows` does those of coordinates.

    Zeros where nobody knows how the probe is held.
    """
    V, at = len(poses), landmarks.positions.size
    residual, noise = np.zeros((V, 3)), np.zeros((V, 3))
    lever, columns = np.zeros((V, 3, 6)), np.zeros((V, 3, landmarks.size))
    if s.rotation is None or s.sigma_rotation is None or landmarks.orientation is None:
        return residual, noise, lever, columns
    residual = Rotation.from_matrix(poses[:, :3, :3] @ s.rotation @ landmarks.orientation.T).as_rotvec()
    noise[:] = np.where(s.used.any(axis=1), s.sigma_rotation**2, 0.0)[:, None]
    lever[..., :3] = np.eye(3)
    columns[..., at : at + 3] = -np.eye(3)
    return residual, noise, lever, columns


def _drawing_rows(landmarks: Landmarks, m: int) -> tuple[Array, Array, Array]:
    """Return the rows that hold D landmarks to their nominal places in a drawing.

    Returns:
        Residual (D, m), length_unit, its change (D, m, U) per unknown of the landmarks, and its known variance (D, m);
        the first three of m rows count, the others have unit variance.
    """
    count = 0 if landmarks.drawing is None else len(landmarks.drawing.target)
    residual, columns, variance = np.zeros((count, m)), np.zeros((count, m, landmarks.size)), np.ones((count, m))
    if landmarks.drawing is None or landmarks.T_reference_part is None:
        return residual, columns, variance
    placed = frames.transform(landmarks.T_reference_part, landmarks.drawing.points)
    for t, (k, p) in enumerate(zip(landmarks.drawing.target, placed, strict=True)):
        residual[t, :3] = landmarks.positions[k] - p
        columns[t, :3, 3 * k : 3 * k + 3] = np.eye(3)
        columns[t, :3, -6:] = np.hstack([frames.skew(p), -np.eye(3)])
        variance[t, :3] = landmarks.drawing.sigma[t] ** 2
    return residual, columns, variance


def fit_landmarks(capture: Capture, T_mount: Array) -> tuple[Landmarks, BlockLeastSquares, Array]:
    """Return the landmarks by least squares under a fixed hand-eye, that least squares problem, and the variances (3,).

    The variances are those of rotation scatter (rad²) and translation scatter (length_unit²) of the flange, and the
    factor on the sensor's noise, by restricted maximum likelihood.

    Args:
        capture: with the effects in use taken out.
        T_mount: (4, 4) maps sensor to mount.
    """
    landmarks = initial_landmarks(capture, T_mount)
    rows = target_rows(capture, T_mount, landmarks)
    mixed = rows.mixed_model(rows.landmarks)
    variances = fit_variances(mixed, both_starts=True).variances
    assert capture.sightings is not None
    # A weak prior, its σ one working distance, keeps landmarks finite that no view shows.
    distance = float(np.median(np.linalg.norm(np.concatenate(capture.sightings.points_by_view()), axis=1)))
    precision = np.full(landmarks.size, distance**-2.0)
    blocks = BlockLeastSquares(
        mixed.z, rows.landmarks, mixed.covariance(variances), precision, np.zeros(landmarks.size)
    )
    return landmarks.updated(blocks.solve()), blocks, variances


def landmarks_covariance(blocks: BlockLeastSquares, rows: TargetRows, hand_eye: Array) -> Array:
    """Return the covariance (U, U) of the landmarks by scatter of the poses, sensor's noise and the hand-eye.

    Args:
        blocks: the least squares problem of the landmarks.
        hand_eye: (6, 6) covariance of T_mount·exp(ξ).
    """
    per_twist = blocks.shift_by_errors(rows.hand_eye)
    return blocks.estimates_covariance() + per_twist @ hand_eye @ per_twist.T
