"""Fuse registered views into one cloud: overlap averaged by weight on a grid of the scans' spacing."""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.measurement.scan import Scan
from stitch.runs.run import FusedCloud

# Points seen at a grazing angle weigh little and edges less, but a place only they saw stays.
_EDGE_WEIGHT = 0.05


def fuse(capture: Capture, poses: Array, cell: float | None = None) -> FusedCloud:
    """Average all views in cells of `cell` (default: the scans' spacing), in the reference frame.

    Returns:
        Points, normals, `residual` = rms distance of the views' surfaces from the fused one along
        its normal (NaN where one view only), and the number of views per point.
    """
    cells = _Cells(capture.scans, poses, cell or capture.spacing)
    points, normals, _weight = cells.mean()
    view_cell, offset, view_weight = cells.view_means(points, normals)
    count = np.bincount(view_cell, minlength=len(points))
    square = np.bincount(view_cell, view_weight * offset**2, len(points))
    total = np.bincount(view_cell, view_weight, len(points))
    residual = np.where(count > 1, np.sqrt(square / total), np.nan)
    return FusedCloud(points, normals, residual, count.astype(np.int32))


def view_residuals(capture: Capture, poses: Array, cell: float) -> list[Array]:
    """Per view (N,): signed distance of its points from the other views' surface, NaN without one.

    Args:
        cell: grid size; wide enough to hold the step between the views.
    """
    cells = _Cells(capture.scans, poses, cell)
    points, normals, weight = cells.mean()
    own_points, own_weight = cells.own()
    rest = weight[cells.cell] - own_weight
    with np.errstate(invalid="ignore", divide="ignore"):
        others = (points[cells.cell] * weight[cells.cell][:, None] - own_points) / rest[:, None]
        signed = np.einsum("ij,ij->i", cells.points - others, normals[cells.cell])
    signed[rest <= 1e-9 * weight[cells.cell]] = np.nan
    return np.split(signed, np.cumsum([len(scan.points) for scan in capture.scans])[:-1])


class _Cells:
    """All points in the reference frame with the grid cell of each."""

    def __init__(self, scans: Sequence[Scan], poses: Array, size: float) -> None:
        pairs = list(zip(scans, poses, strict=True))
        self.points = np.concatenate([frames.transform(T, s.points) for s, T in pairs])
        self.normals = np.concatenate([frames.rotate(T, s.normals) for s, T in pairs])
        self.weight = np.concatenate([s.confidence**2 * np.where(s.usable, 1.0, _EDGE_WEIGHT) for s in scans])
        self.view = np.repeat(np.arange(len(scans)), [len(s.points) for s in scans])
        self.views = len(scans)
        index = np.floor((self.points - self.points.min(axis=0)) / size).astype(np.int64)
        shape = index.max(axis=0) + 1
        key = np.ravel_multi_index(tuple(index.T), tuple(shape))
        _, self.cell = np.unique(key, return_inverse=True)
        self.cells = int(self.cell.max()) + 1

    def mean(self) -> tuple[Array, Array, Array]:
        """Weighted mean points and unit normals (C, 3), and total weight (C,)."""
        weight = np.bincount(self.cell, self.weight, self.cells)
        points = self._sum(self.cell, self.points, self.cells) / weight[:, None]
        normals = self._sum(self.cell, self.normals, self.cells)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return points, normals / np.maximum(length, 1e-12), np.asarray(weight, float)

    def own(self) -> tuple[Array, Array]:
        """Per point: weighted sum of points (N, 3) and weight (N,) of its own view in its cell."""
        _, group = np.unique(self.cell * self.views + self.view, return_inverse=True)
        size = int(group.max()) + 1
        weight: Array = np.asarray(np.bincount(group, self.weight, size), float)
        return self._sum(group, self.points, size)[group], weight[group]

    def view_means(self, points: Array, normals: Array) -> tuple[Indices, Array, Array]:
        """Per (cell, view): its cell, the mean offset along the cell's normal, and its weight."""
        offset = np.einsum("ij,ij->i", self.points - points[self.cell], normals[self.cell])
        key, group = np.unique(self.cell * self.views + self.view, return_inverse=True)
        weight: Array = np.asarray(np.bincount(group, self.weight, len(key)), float)
        mean: Array = np.bincount(group, self.weight * offset, len(key)) / weight
        return np.asarray(key // self.views, np.int64), mean, weight

    def _sum(self, group: Indices, values: Array, size: int) -> Array:
        return np.stack([np.bincount(group, self.weight * values[:, i], size) for i in range(3)], axis=1)
