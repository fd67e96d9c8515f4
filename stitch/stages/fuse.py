"""Fuse registered views into one cloud: overlap averaged by weight on a grid of the scans' spacing."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import MIN_COSINE, Measurement, intensity_scale
from stitch.measurement.scan import Scan, box_corners
from stitch.measurement.session import Session
from stitch.model.forward import moves_points, point_correction
from stitch.model.model import Model
from stitch.runs.run import FusedCloud
from stitch.system.threads import map_parts, parallel

# Points seen at a grazing angle weigh little and edges less, but a place only they saw stays.
_EDGE_WEIGHT = 0.05


@dataclass(frozen=True)
class PlacedPoints:
    """Points of registered views in the reference frame."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3)
    weight: Array  # (N,)
    view: Indices  # (N,)


def fuse(capture: Capture, poses: Array, cell: float | None = None) -> FusedCloud:
    """Average all views in cells of `cell` (default: the scans' spacing), in the reference frame.

    Returns:
        Points, normals, `residual` = rms distance of the views' surfaces from the fused one along
        its normal (NaN where one view only), and the number of views per point.
    """
    return fuse_points(concatenate_points(_place_scans(capture.scans, poses)), cell or capture.spacing)


def fuse_points(points_of_views: PlacedPoints, cell: float, axis: int = 0) -> FusedCloud:
    """The same of placed points, in the order of cells along `axis`; the grid is the reference frame's own."""
    cells = _GridCells(points_of_views, cell, axis)
    points, normals = cells.mean()
    view_cell, offset, view_weight = cells.view_means(points, normals)
    count = np.bincount(view_cell, minlength=len(points))
    square = np.bincount(view_cell, view_weight * offset**2, len(points))
    total = np.bincount(view_cell, view_weight, len(points))
    residual = np.where(count > 1, np.sqrt(square / total), np.nan)
    return FusedCloud(points, normals, residual, count.astype(np.int32))


def point_weights(confidence: Array, usable: Array) -> Array:
    """(N,) what points count by their cosine of incidence, and by whether they lie on a smooth surface."""
    return np.asarray(confidence**2 * np.where(usable, 1.0, _EDGE_WEIGHT))


def concatenate_points(parts: Sequence[PlacedPoints]) -> PlacedPoints:
    """The points of several views, one view after the other."""
    names = [f.name for f in fields(PlacedPoints)]
    return PlacedPoints(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def place_points(T: Array, view: int, points: Array, normals: Array, weight: Array) -> PlacedPoints:
    """Points (N, 3) of one view with normals and weights, scanner frame, by its T_reference_scanner (4, 4)."""
    return PlacedPoints(frames.transform(T, points), frames.rotate(T, normals), weight, np.full(len(points), view))


def _place_scans(scans: Sequence[Scan], poses: Array) -> list[PlacedPoints]:
    return [
        place_points(T, v, s.points, s.normals, point_weights(s.confidence, s.usable))
        for v, (s, T) in enumerate(zip(scans, poses, strict=True))
    ]


class _GridCells:
    """Placed points with the grid cell of each."""

    def __init__(self, placed: PlacedPoints, size: float, axis: int = 0) -> None:
        self.placed = placed
        self.views = int(placed.view.max()) + 1
        index = np.floor(placed.points / size).astype(np.int64)
        index -= index.min(axis=0)
        order = [axis, *(i for i in range(3) if i != axis)]
        shape = index.max(axis=0) + 1
        key = np.ravel_multi_index(tuple(index.T[order]), tuple(shape[order]))
        _, self.cell = np.unique(key, return_inverse=True)
        self.cells = int(self.cell.max()) + 1

    def mean(self) -> tuple[Array, Array]:
        """Weighted mean points and unit normals (C, 3)."""
        weight = np.bincount(self.cell, self.placed.weight, self.cells)
        points = self._sum(self.cell, self.placed.points, self.cells) / weight[:, None]
        normals = self._sum(self.cell, self.placed.normals, self.cells)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return points, normals / np.maximum(length, 1e-12)

    def view_means(self, points: Array, normals: Array) -> tuple[Indices, Array, Array]:
        """Per (cell, view): its cell, the mean offset along the cell's normal, and its weight."""
        offset = np.einsum("ij,ij->i", self.placed.points - points[self.cell], normals[self.cell])
        key, group = np.unique(self.cell * self.views + self.placed.view, return_inverse=True)
        weight: Array = np.asarray(np.bincount(group, self.placed.weight, len(key)), float)
        mean: Array = np.bincount(group, self.placed.weight * offset, len(key)) / weight
        return np.asarray(key // self.views, np.int64), mean, weight

    def _sum(self, group: Indices, values: Array, size: int) -> Array:
        return np.stack([np.bincount(group, self.placed.weight * values[:, i], size) for i in range(3)], axis=1)


# Fuse scans of which memory holds only some points: every point read once more, slab by slab of the part.
#
# The slabs end where cells of the grid end, so that what comes out does not depend on how many there are. A point takes
# normal and edge from the nearest one in memory, whose surface was that of all points.

# Points of a slab; as many slabs are at work as there are cores, at some 200 bytes a point.
_SLAB = 2_500_000
# Effects of scanner and part move a point by less than this share of the view's size.
_MAX_MOVE = 0.02


@dataclass(frozen=True)
class RegisteredSession:
    """A session under its model, with single views registered."""

    session: Session
    measurement: Measurement  # with the effects in use
    model: Model
    own: Capture  # without them
    poses: Array  # (V, 4, 4) T_reference_scanner

    @cached_property
    def intensity_scale(self) -> tuple[float, float] | None:
        """Mean and standard deviation by which the model's effects count intensities."""
        return intensity_scale(self.session)


def fuse_every_point(registered: RegisteredSession, slab: int = _SLAB) -> FusedCloud:
    """Fuse all points that were scanned, those in memory and those in files.

    Args:
        slab: points that are fused at a time; with more of them the result is held in files without a name.

    Raises:
        InputError: a scan is not what it was when it was read, or there is no room for the fused cloud.
    """
    session, own, poses = registered.session, registered.own, registered.poses
    cell = float(np.median([scan.scanned_spacing for scan in own.scans]))
    if all(view.cloud is None or view.cloud.whole is None for view in session.views):
        return fuse(own, poses, cell)
    ends, axis = _slabs(registered, cell, slab)

    def of_slab(bounds: tuple[float, float]) -> FusedCloud | None:
        low, high = (cell * number for number in bounds)
        every = concatenate_points([_points_in_slab(registered, v, axis, low, high) for v in range(len(own.scans))])
        return fuse_points(every, cell, axis) if len(every.points) else None

    clouds = parallel(of_slab, pairwise(ends), "fusing slabs")
    found = (cloud for cloud in clouds if cloud is not None)
    return next(found) if len(ends) == 2 else FusedCloud(**map_parts(vars(cloud) for cloud in found))


def _slabs(registered: RegisteredSession, cell: float, slab: int) -> tuple[list[float], int]:
    """Numbers of cells at which slabs end along the part's longest axis, and that axis."""
    own, poses = registered.own, registered.poses
    shown = [frames.transform(T, scan.points) for scan, T in zip(own.scans, poses, strict=True)]
    low, high = (f([f(p, axis=0) for p in shown], axis=0) for f in (np.min, np.max))
    axis = int(np.argmax(high - low))
    first = np.floor(low[axis] / cell)
    share = [1.0 if v.cloud is None else v.cloud.count / len(v.cloud.points) for v in registered.session.views]
    length = int(np.floor(high[axis] / cell) - first) + 1
    along = np.zeros(length)
    for points, per_point in zip(shown, share, strict=True):
        along += per_point * np.bincount((np.floor(points[:, axis] / cell) - first).astype(np.int64), minlength=length)
    number = np.floor((np.cumsum(along) - along / 2) / slab)
    ends = first + np.flatnonzero(np.diff(number) > 0) + 1
    return [-np.inf, *ends.tolist(), np.inf], axis


def _points_in_slab(registered: RegisteredSession, v: int, axis: int, low: float, high: float) -> PlacedPoints:
    """Points of view v between two planes of the reference frame, with the view's number."""
    T, cloud, scan = registered.poses[v], registered.session.views[v].cloud, registered.own.scans[v]
    whole = None if cloud is None else cloud.whole
    if whole is None:
        points, normals, weight = scan.points, scan.normals, point_weights(scan.confidence, scan.usable)
    else:
        ends = frames.transform(T, box_corners(whole.box))[:, axis]
        margin = _MAX_MOVE * float(np.ptp(whole.box, axis=0).max())
        if ends.max() + margin < low or ends.min() - margin > high:
            return place_points(T, v, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        every = whole.read()
        height = frames.transform(T, every.points)[:, axis]
        near = np.flatnonzero((height >= low - margin) & (height < high + margin))
        points, normals, weight = _corrected_points(registered, v, every.points[near], every.scalars, near)
    height = frames.transform(T, points)[:, axis]
    keep = (height >= low) & (height < high)
    return place_points(T, v, points[keep], normals[keep], weight[keep])


def _corrected_points(
    registered: RegisteredSession, v: int, points: Array, scalars: dict[str, Array], index: Indices
) -> tuple[Array, Array, Array]:
    """Points (N, 3) of view v, scanner frame, without the effects in use; their normals (N, 3) and weights (N,)."""
    scan = registered.measurement.capture.scans[v]
    _, nearest = scan.tree.query(points, k=1)
    normals = scan.normals[nearest]
    confidence = np.abs(np.einsum("ij,ij->i", normals, scan.rays(points)))
    terms = registered.model.terms
    if moves_points(terms):
        scale = registered.intensity_scale
        view = replace(
            registered.measurement.scan_views[v],
            cosine=np.maximum(confidence, MIN_COSINE),
            intensity=None if scale is None else (scalars["intensity"][index] - scale[0]) / scale[1],
        )
        points = points + point_correction(terms, points, view, registered.own.poses(registered.model.T_mount)[v])
    return points, normals, point_weights(confidence, scan.usable[nearest])
