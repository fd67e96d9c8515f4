"""The field of disagreement: per place of the part, how far each view puts the surface from where the others put it.

The distance of two matched points carries the noise of both. Averaged over a patch the noise goes and what repeats
stays: the error of the model as it shows on the part. A patch is a Gaussian mean over its neighbourhood on the same
side of the part. Its radius is the smallest at which the standard error of nearly all patches is below a step of the
colours. All states of a model are read by the same correspondences on the same patches, so that the difference of two
fields is that of the models alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pykdtree.kdtree import KDTree
from scipy.sparse import csr_matrix

from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.units import MILLIMETRES
from stitch.observations.surfaces.matching import Match
from stitch.observations.surfaces.normal_equations import RMS_GATE
from stitch.session.session import SessionData

# A colour bar shows so many steps that people tell apart.
COLOUR_STEPS = 10
# By how much poses of an arm of which nobody states it scatter, mm, and how much more is full of colour.
_USUAL_ARM, _PALE = 0.02, 4.0
# Mean of |x| of a normal x of unit sigma.
_MEAN_OF_NORMAL = float(np.sqrt(2 / np.pi))
# Radii of the patches that are tried, the smallest first, as shares of the part's longest side.
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
class DisagreementField:
    """Signed distances of V views at K patches, positive outwards; NaN where a view and no other sees the patch."""

    values: Array  # (V, K) length_unit
    sigma: Array  # (V, K) standard errors

    @cached_property
    def overall(self) -> Array:
        """(K,) mean of |value| over the views that see a patch, length_unit; NaN where they are fewer than two."""
        return _mean_over_views(np.abs(self.values))

    @cached_property
    def by_view(self) -> Array:
        """(V,) mean of |value| over the patches that a view sees, length_unit; NaN where it shares none with others."""
        seen = np.isfinite(self.values)
        count = seen.sum(axis=1)
        return np.where(count > 0, np.where(seen, np.abs(self.values), 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)

    @property
    def mean_abs(self) -> float:
        """Return the mean of |value| over the part."""
        return float(np.nanmean(self.overall)) if np.isfinite(self.overall).any() else float("nan")

    @property
    def noise(self) -> float:
        """Return what `mean_abs` would be if noise were all there is."""
        if not np.isfinite(self.sigma).any():
            return float("nan")
        return _MEAN_OF_NORMAL * float(np.nanmean(_mean_over_views(self.sigma)))

    def quantile(self, share: float = 0.95) -> float:
        """Return the quantile of `overall` over the patches, length_unit: `share` of the part disagrees by less."""
        seen = self.overall[np.isfinite(self.overall)]
        return float(np.quantile(seen, share)) if len(seen) else float("nan")


def full_colour_distance(field: DisagreementField, session: SessionData) -> float:
    """Return the distance at which the colour scale ends, length_unit.

    It is the largest of three: the 95 % quantile of the field, `COLOUR_STEPS` standard errors, so that a step of colour
    is no noise, and `_PALE` times the scatter of a usual or stated arm, which is so drawn pale.
    """
    stated = session.repeatability.sigma_translation
    usual = _USUAL_ARM / MILLIMETRES[session.length_unit] if stated is None else stated
    return max(field.quantile(), COLOUR_STEPS * largest_standard_error(field.sigma), _PALE * usual)


def largest_standard_error(sigma: Array) -> float:
    """Return the limit that nearly all standard errors stay below."""
    return float(np.nanquantile(sigma, 0.9))


def _mean_over_views(values: Array) -> Array:
    """Return the means (K,) of values (V, K) over the views with a finite value; NaN where they are fewer than two."""
    seen = np.isfinite(values)
    count = seen.sum(axis=0)
    return np.where(count > 1, np.where(seen, values, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def patches_of(matches: Sequence[Match], view_count: int, scale: float, model_distances: Array) -> "Patches":
    """Return patches over the surface that the matches cover, as small as the noise allows.

    The radii `_RADII`, shares of the part's longest side, are tried in growing order. The first is taken whose standard
    errors are below one step of colour: the 95 % quantile of |field| over `COLOUR_STEPS`. If no patch has a standard
    error, a larger radius does not help, and the present one is taken. If no radius is enough, it is the last.

    Args:
        matches: M correspondences of all overlapping pairs, at the registered poses: distances there are noise.
        view_count: number V of views.
        scale: robust sigma of the distances, length_unit; those beyond `RMS_GATE` times it are edges and are dropped.
        model_distances: (M,) distances under the model whose field is to be drawn, length_unit.
    """
    pairs = _Correspondences(matches, view_count, scale)
    # Of all points but a hundredth: single ones far off would make the part longer.
    longest_side = float(np.ptp(np.quantile(pairs.middle, [0.005, 0.995], axis=1), axis=0).max())
    for share in _RADII:
        patches = Patches(pairs, share * longest_side)
        colour_step = patches.field(model_distances).quantile() / COLOUR_STEPS
        if not np.isfinite(patches.sigma).any() or largest_standard_error(patches.sigma) <= colour_step:
            break
    return patches


class _Correspondences:
    """The R correspondences of M whose distance is inside the robust gate, at the poses of the matches."""

    def __init__(self, matches: Sequence[Match], view_count: int, scale: float) -> None:
        """Join the arrays of all matches, in their order.

        Args:
            matches: M correspondences, v less w.
            view_count: number V of views.
            scale: robust sigma of the distances, length_unit.
        """
        self.view_count = view_count
        self.distances = np.concatenate([m.residual for m in matches])  # (M,)
        self.inside: Mask = np.abs(self.distances) < RMS_GATE * scale  # (M,)
        # Coordinates first: sums and limits over rows of three take several times as long.
        self.middle, self.normal = (
            np.concatenate([getattr(m, name).T for m in matches], axis=1).compress(self.inside, axis=1)
            for name in ("middle", "normal")
        )  # (3, R)
        self.side = facing_side(self.normal)
        sides = [np.concatenate([np.full(len(m.residual), getattr(m, side)) for m in matches]) for side in "vw"]
        self.view = np.concatenate([side[self.inside] for side in sides]).astype(np.int64)  # (2R,) first all v


class Patches:
    """K patches of one radius on the part, and which correspondences belong to them, with which weight."""

    def __init__(self, pairs: _Correspondences, radius: float) -> None:
        """Group the correspondences into C cells, and these into K patches; weigh each cell for each patch.

        Args:
            pairs: the R correspondences.
            radius: standard deviation of the weights, length_unit.
        """
        cell, centre, facing = group_points(pairs.middle, pairs.normal, pairs.side, _CELL * radius)
        self._inside = pairs.inside
        self._cell_of = np.concatenate([cell, cell]) * pairs.view_count + pairs.view
        counts = np.bincount(self._cell_of, minlength=len(centre) * pairs.view_count)
        self._counts = counts.reshape(len(centre), pairs.view_count).astype(float)  # (C, V)
        sides = facing_side(facing.T)
        _, self.points, self.normals = group_points(centre.T, facing.T, sides, _APART * radius)  # (K, 3), outwards
        self.radius = radius  # standard deviation of the weights, length_unit
        self._kernel = _kernel(self.points, self.normals, centre, facing, radius)
        self.sigma = self._standard_errors(pairs.distances)  # (V, K) of the means, NaN where nobody can say

    def field(self, distances: Array) -> DisagreementField:
        """Return the field of signed distances (M,) of all correspondences in their order, v less w."""
        with np.errstate(invalid="ignore", divide="ignore"):
            value = self._kernel @ self._sums(distances) / (self._kernel @ self._counts)
        return DisagreementField(np.where(np.isfinite(self.sigma), value.T, np.nan), self.sigma)

    def _sums(self, distances: Array) -> Array:
        """Return (C, V) sums of distances (M,) by cell and view, those of a w with the other sign."""
        e = distances[self._inside]
        sums = np.bincount(self._cell_of, np.concatenate([e, -e]), self._counts.size)
        return sums.reshape(self._counts.shape).astype(float)

    def _standard_errors(self, distances: Array) -> Array:
        """Return standard errors (V, K) of each view's mean in each patch, by the scatter of the cells' means about it.

        With weights a of the cells (kernel times counts), means m of the cells and d of the patch, the variance is
        Σ a² (m − d)² / (Σ a)² · N/(N − 1); N = (Σ a)²/Σ a² is the effective number of cells. Neighbouring distances
        are correlated, since they share points; cells are wide enough to be independent.

        Args:
            distances: (M,) at the registered poses, length_unit, where they are noise.
        """
        kernel, n = self._kernel, self._counts
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.nan_to_num(self._sums(distances) / n)
            total = kernel @ n
            value = kernel @ (n * mean) / total
            # Σ a² (m − d)² multiplied out, each sum over the cells a product of sparse matrices.
            kernel2, n2 = kernel.multiply(kernel).tocsr(), n**2
            spread = kernel2 @ (n2 * mean**2) - 2 * value * (kernel2 @ (n2 * mean)) + value**2 * (kernel2 @ n2)
            cells = total**2 / (kernel2 @ n2)
            sigma = np.sqrt(np.maximum(spread, 0) * cells / (cells - 1)) / total
        return np.where(cells > _ENOUGH, sigma, np.nan).T


def _kernel(place: Array, outwards: Array, centre: Array, facing: Array, radius: float) -> csr_matrix:
    """Return Gaussian weights (K, C) of C cells for K patches; zero for cells far away or on another side of the part.

    Args:
        place, outwards: (K, 3) centres of the patches and their unit normals.
        centre, facing: (C, 3) those of the cells.
        radius: standard deviation of the weights, length_unit.
    """
    # No more cells than this lie within the reach on a surface.
    near = min(len(centre), int(4 * (_REACH / _CELL) ** 2))
    distance, index = KDTree(centre).query(place, k=near, distance_upper_bound=_REACH * radius)
    distance = distance.reshape(len(place), -1)
    index = index.reshape(len(place), -1)
    within = np.isfinite(distance)
    index = np.where(within, index, 0).astype(np.int64)
    within &= np.einsum("kni,ki->kn", facing.take(index, axis=0), outwards) > _SAME_SIDE
    row = np.broadcast_to(np.arange(len(place))[:, None], index.shape)[within]
    weights = np.exp(-((distance[within] / radius) ** 2) / 2)
    return csr_matrix((weights, (row, index[within])), shape=(len(place), len(centre)))


def facing_side(normals: Array) -> Indices:
    """Return for normals (3, N) the number (N,), 0 … 5, of the cube's side that each faces most."""
    axis = np.abs(normals).argmax(axis=0)
    return 2 * axis + (normals[axis, np.arange(len(axis))] > 0)


def group_points(points: Array, normals: Array, side: Indices, size: float) -> tuple[Indices, Array, Array]:
    """Group points by the cells of a cubic grid and by the side that they face; the two faces of a sheet stay apart.

    Args:
        points, normals: (3, N).
        side: (N,) number of the side of a cube that each normal faces (`facing_side`).
        size: edge of a cell, in the unit of the points.

    Returns:
        Group (N,) of every point; and for G groups mean points (G, 3) and unit normals (G, 3).
    """
    index = np.floor((points - points.min(axis=1, keepdims=True)) / size).astype(np.int64)
    key = np.ravel_multi_index((*index, side), (*(index.max(axis=1) + 1), 6))
    # The grid has some eighty cells a side: a table of all takes less than a search for the different ones.
    every = np.bincount(key)
    group = (np.cumsum(every > 0) - 1)[key]
    count = every[every > 0]
    point, normal = (
        np.stack([np.bincount(group, x, len(count)) for x in values], axis=1) / count[:, None]
        for values in (points, normals)
    )
    return group, point, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
