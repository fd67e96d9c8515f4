"""Fuse registered views into one cloud: overlap averaged by weight on a grid of the scans' spacing."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.measurement.scan import Scan
from stitch.runs.run import FusedCloud

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
