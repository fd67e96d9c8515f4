"""Patches of the part on which the field of disagreement is read, as small as the noise allows.

A patch is a Gaussian mean over its neighbourhood on the same side of the part. Its radius is the smallest at which the
standard error of nearly all patches is below a step of the colours. All states of a model are read by the same
correspondences on the same patches, so that the difference of two fields is that of the models alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pykdtree.kdtree import KDTree
from scipy.sparse import csr_matrix

from stitch.comparison.disagreement_field import COLOUR_STEPS, DisagreementField, largest_standard_error
from stitch.frames import Array, Indices, Mask
from stitch.observations.surfaces.gram import RMS_GATE
from stitch.observations.surfaces.match import Match

# Radii of the patches that are tried, as shares of the part's longest side.
_RADII = (1 / 32, 1 / 24, 1 / 18, 1 / 13, 1 / 10)
# A patch counts its correspondences in cells of this share of its radius; the cells' scatter is its standard error.
_CELL = 0.4
# Fewer cells than this say nothing about their scatter.
_ENOUGH = 5.0
# Patches this much closer than their radius overlap enough to leave no place between them.
_APART = 0.7
# Radii after which the weights end.
_REACH = 2.0
_SAME_SIDE = np.cos(np.radians(60.0))


@dataclass(frozen=True)
class Patches:
    """K patches of the part, and which correspondences belong to them, with which weight."""

    points: Array  # (K, 3) reference frame
    normals: Array  # (K, 3) unit, outwards
    radius: float  # standard deviation of the weights, length_unit
    sigma: Array  # (V, K) standard errors of the means, NaN where nobody can say
    kernel: csr_matrix  # (K, C) weights of cells
    counts: "_Counts"

    def field(self, distances: Array) -> DisagreementField:
        """The field of signed distances (M,) of all correspondences in their order, v less w."""
        count = self.counts.by_cell(np.ones_like(distances), 1.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            value = self.kernel @ self.counts.by_cell(distances, -1.0) / (self.kernel @ count)
        return DisagreementField(np.where(np.isfinite(self.sigma), value.T, np.nan), self.sigma)


@dataclass(frozen=True)
class _Counts:
    """Both sides of every correspondence that counts, by cell and view."""

    inside: Mask  # (M,) of all correspondences
    view: Indices  # (2R,) first all v, then all w
    cell: Indices  # (R,)
    views: int
    cells: int

    def by_cell(self, values: Array, sign: float) -> Array:
        """(C, V) sums of values (M,); of a w its value times `sign`."""
        e = values[self.inside]
        key = np.concatenate([self.cell, self.cell]) * self.views + self.view
        sums = np.bincount(key, np.concatenate([e, sign * e]), self.cells * self.views)
        return np.asarray(sums.reshape(self.cells, self.views), float)


def patches_of(matches: Sequence[Match], views: int, scale: float, model_distances: Array) -> Patches:
    """Patches over the surface that the matches cover, as small as the noise allows.

    Args:
        matches: of all overlapping pairs, with the views where they agree best: what scatters there is noise.
        views: their number V.
        scale: robust sigma of the distances; what lies beyond the gate of the rms is an edge.
        model_distances: (M,) distances under the model whose field the colours are to show.
    """
    quiet = np.concatenate([m.residual for m in matches])
    inside = np.abs(quiet) < RMS_GATE * scale
    middle = np.concatenate([m.middle for m in matches])[inside]
    normal = np.concatenate([m.normal for m in matches])[inside]
    pair = [np.concatenate([np.full(len(m.residual), getattr(m, side)) for m in matches])[inside] for side in "vw"]
    view = np.concatenate(pair).astype(np.int64)
    size = float(np.ptp(np.quantile(middle, [0.005, 0.995], axis=0), axis=0).max())
    for share in _RADII:
        radius = share * size
        cell, centre, facing = _group_points(middle, normal, _CELL * radius)
        counts = _Counts(inside, view, cell, views, len(centre))
        _, place, outwards = _group_points(centre, facing, _APART * radius)
        kernel = _kernel(place, outwards, centre, facing, radius)
        sigma = _standard_errors(kernel, counts, quiet)
        found = Patches(place, outwards, radius=radius, sigma=sigma, kernel=kernel, counts=counts)
        if (
            not np.isfinite(sigma).any()
            or largest_standard_error(sigma) <= found.field(model_distances).quantile() / COLOUR_STEPS
        ):
            break
    return found


def _standard_errors(kernel: csr_matrix, counts: _Counts, quiet: Array) -> Array:
    """(V, K) of the weighted mean of the cells of a patch, by their scatter about it: Σ a²(m − d)², a their weights.

    Neighbouring distances share points and normals; cells are wide enough not to.
    """
    n = counts.by_cell(np.ones_like(quiet), 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nan_to_num(counts.by_cell(quiet, -1.0) / n)
        total = kernel @ n
        value = kernel @ (n * mean) / total
        square, a2 = kernel.multiply(kernel).tocsr(), n**2
        spread = square @ (a2 * mean**2) - 2 * value * (square @ (a2 * mean)) + value**2 * (square @ a2)
        cells = total**2 / (square @ a2)
        sigma = np.sqrt(np.maximum(spread, 0) * cells / (cells - 1)) / total
    return np.asarray(np.where(cells > _ENOUGH, sigma, np.nan).T)


def _kernel(place: Array, outwards: Array, centre: Array, facing: Array, radius: float) -> csr_matrix:
    """(K, C) Gaussian weights of the cells about every place that face the same way."""
    near = min(len(centre), int(4 * (_REACH / _CELL) ** 2))
    distance, index = KDTree(centre).query(place, k=near, distance_upper_bound=_REACH * radius)
    distance, index = distance.reshape(len(place), -1), index.reshape(len(place), -1)
    found = np.isfinite(distance)
    index = np.where(found, index, 0).astype(np.int64)
    found &= np.einsum("kni,ki->kn", facing[index], outwards) > _SAME_SIDE
    row = np.broadcast_to(np.arange(len(place))[:, None], index.shape)[found]
    weights = np.exp(-((distance[found] / radius) ** 2) / 2)
    return csr_matrix((weights, (row, index[found])), shape=(len(place), len(centre)))


def _group_points(points: Array, normals: Array, size: float) -> tuple[Indices, Array, Array]:
    """Number of the group of every point, and per group mean point and unit normal; both sides of a sheet differ."""
    side = 2 * np.abs(normals).argmax(axis=1)
    side += np.take_along_axis(normals, (side // 2)[:, None], axis=1)[:, 0] > 0
    index = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    key = np.ravel_multi_index((*index.T, side), (*(index.max(axis=0) + 1), 6))
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    point, normal = (
        np.stack([np.bincount(group, x, len(count)) for x in values.T], axis=1) / count[:, None]
        for values in (points, normals)
    )
    return group.astype(np.int64), point, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
