"""What the views see: positions of targets, the orientation of a probe, the place of a drawing; all unknown."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.measurement.labelled_points import NominalTargets
from stitch.measurement.sightings import Sightings


@dataclass(frozen=True)
class Drawing:
    """Nominal targets among those seen: measurements of them in the part frame."""

    target: Indices  # (T,) number of the target
    points: Array  # (T, 3) part frame
    sigma: Array  # (T,)


@dataclass(frozen=True)
class Landmarks:
    """K targets in the reference frame; the unknowns are 3K positions, 3 of a probe's turn, 6 of a drawing."""

    positions: Array  # (K, 3)
    orientation: Array | None = None  # (3, 3) R_reference_probe
    drawing: Drawing | None = None
    T_reference_part: Array | None = None  # (4, 4) where the drawing lies

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.positions.size + 3 * (self.orientation is not None) + 6 * (self.drawing is not None)

    def updated(self, by: Array) -> "Landmarks":
        """After a step of all unknowns: shifts, a left rotation vector, a left twist of the drawing."""
        split = self.positions.size
        orientation, T, at = self.orientation, self.T_reference_part, split
        if orientation is not None:
            orientation = Rotation.from_rotvec(by[at : at + 3]).as_matrix() @ orientation
            at += 3
        if T is not None:
            T = frames.exp(by[at : at + 6]) @ T
        return replace(
            self, positions=self.positions + by[:split].reshape(-1, 3), orientation=orientation, T_reference_part=T
        )


def drawing_of(nominal: NominalTargets | None, sightings: Sightings) -> Drawing | None:
    """The drawing of the targets seen; where it states no sigma, a target is as good as one sighting of it."""
    if nominal is None:
        return None
    names, usual = sightings.targets, float(np.median(sightings.sigma[sightings.used]))
    pairs = [(names.index(name), i) for i, name in enumerate(nominal.targets) if name in names]
    target, rows = (np.array(column) for column in zip(*pairs, strict=True))
    sigma = nominal.sigma[rows]
    return Drawing(target, nominal.points[rows], np.where(np.isnan(sigma), usual, sigma))


def initial_landmarks(own: Capture, T_mount: Array, drawing: Drawing | None = None) -> Landmarks:
    """Landmarks in the middle (median) of where the views put them under a hand-eye; NaN for one that nobody sees.

    Args:
        own: without the effects in use.
    """
    s = own.sightings
    assert s is not None
    poses = own.poses(T_mount)
    placed = frames.transform(poses, s.points)
    positions = np.full((len(s.targets), 3), np.nan)
    for k in range(len(s.targets)):
        here = placed[s.used & (s.target == k)]
        if len(here):
            positions[k] = np.median(here, axis=0)
    orientation = None
    if s.rotation is not None:
        turned = (poses[:, :3, :3] @ s.rotation)[s.used.any(axis=1)]
        first = frames.nearest_rotation(np.median(turned, axis=0))
        # The middle of the turns against a first guess: medians of matrices lean.
        off = Rotation.from_matrix(turned @ first.T).as_rotvec()
        orientation = Rotation.from_rotvec(np.median(off, axis=0)).as_matrix() @ first
    T = None if drawing is None else fit_rigid_motion(drawing.points, positions[drawing.target])
    return Landmarks(positions, orientation, drawing, T)


def fit_rigid_motion(points: Array, targets: Array) -> Array:
    """(4, 4) the rigid motion that brings points (N, 3) closest to targets (N, 3), least squares (Kabsch 1976)."""
    known = np.isfinite(targets).all(axis=1)
    a, b = points[known], targets[known]
    R = frames.nearest_rotation((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    return frames.make(R, b.mean(axis=0) - R @ a.mean(axis=0))
