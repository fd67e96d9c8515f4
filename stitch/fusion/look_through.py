"""Which places views look through: they measured a surface behind them, or nothing where they ought to have.

A range image per view, all over the same field of the scanner: a stereographic map of the rays, whose bins hold the
nearest surface. What stands before the nearest of nine bins stands where the view saw past.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.session.scan import Scan, centroid
from stitch.system.threads import parallel

# Edge of a bin in spacings between rays: few bins of a surface stay empty.
_BIN = 1.5
# Bins of nine that show a surface, where it counts as seen and closed.
_CLOSED = 6
# Slope of the steepest surface that is seen, along 80°: by so many widths of a bin it goes deeper across one bin. What
# lies deeper in the same bin lies behind another surface.
_STEEPEST = 6.0
# A view of which more lies behind its own surfaces did not look from its eye, as several scans in one file.
_MOST_BEHIND = 0.1
# Share of the measured ranges at either end that are left out of the reach of a view: stray points.
_STRAY = 0.01
# What lies behind the scanner lies far off on the map.
_BEHIND = 1e-3
# A surface that faces a view within 60° is seen by it.
_FACING = 0.5


@dataclass(frozen=True)
class RangeImages:
    """The common field of V views on a grid of H × W bins, and what each view saw in each bin."""

    axes: Array  # (3, 3) rows: across, up, and the middle of the field, scanner frame
    low: Array  # (2,) corner of the grid on the map
    bin: float  # edge of a bin on the map
    nearest: Array  # (V, H, W) range of the nearest surface in nine bins, −inf where there is no closed one
    empty: Mask  # (V, H, W): nothing in nine bins
    field: Mask  # (H, W): two views or more measured something
    reach: tuple[float, float]  # least and largest range that was measured, without stray points
    trusted: Mask  # (V,): looked from one eye

    def may_concern(self, scan: Scan, T: Array, centres: Array, radii: Array) -> Mask:
        """Return a mask (G,) of the balls that a view may see or look through: in its field, and not too far off.

        A quick test: balls it excludes need not be looked up in the range image.

        Args:
            scan: the view's.
            T: (4, 4) T_reference_scanner of the view.
            centres: (G, 3) of the balls, reference frame.
            radii: (G,) length_unit.
        """
        from_eye = frames.transform(frames.inverse(T), centres) - scan.eye
        ranges = np.linalg.norm(from_eye, axis=1)
        # On the map lengths are tangents of half the angles to the middle of the field.
        corners = np.abs(np.stack([self.low, self.low + self.bin * np.array(self.field.shape)]))
        field_angle = 2 * np.arctan(np.linalg.norm(corners.max(axis=0)))
        cosine = from_eye @ self.axes[2] / np.maximum(ranges, 1e-300)
        ball_angle = np.arcsin(np.minimum(radii / np.maximum(ranges, 1e-300), 1))
        inside = np.arccos(np.clip(cosine, -1, 1)) <= field_angle + ball_angle
        farthest = max(float(self.nearest.max()), self.reach[1])
        return (ranges <= radii) | (inside & (ranges - radii <= farthest))

    def views_through(self, scan: Scan, T: Array, v: int, columns: Array, normals: Array, margin: float) -> Indices:
        """Return per place (N,) 1 where view v measured a surface behind it, 2 where it ought to have seen it, else 0.

        It ought to have seen a place that faces it and lies within the measured ranges, if it measured nothing around
        the place's ray. A view that did not look from one eye (`trusted`) says nothing: 0.

        Args:
            scan: the view's.
            T: (4, 4) T_reference_scanner of the view.
            columns: (3, N) x, y, z of the places, reference frame.
            normals: (N, 3) of the places, reference frame.
            margin: least distance from a place to the surface behind it, length_unit.
        """
        through = np.zeros(columns.shape[1], np.int64)
        if not self.trusted[v]:
            return through
        # Column by column: products of matrices this narrow take several times as long.
        x, y, z = columns
        R = self.axes @ T[:3, :3].T
        t = -R @ T[:3, 3] - self.axes @ scan.eye
        across, up, ahead = (a * x + b * y + c * z + d for (a, b, c), d in zip(R, t, strict=True))
        ranges = np.sqrt(across**2 + up**2 + ahead**2)
        # As `_stereographic_map`, in bins.
        scale = self.bin * np.maximum(ranges + ahead, _BEHIND * ranges)
        i, j = across / scale - self.low[0] / self.bin, up / scale - self.low[1] / self.bin
        inside = np.flatnonzero((i >= 0) & (i < self.field.shape[0]) & (j >= 0) & (j < self.field.shape[1]))
        ranges, i, j = ranges[inside], i[inside].astype(np.int64), j[inside].astype(np.int64)
        through[inside[self.nearest[v, i, j] > ranges + margin]] = 1
        missed = self.empty[v, i, j] & self.field[i, j] & (ranges > self.reach[0]) & (ranges < self.reach[1])
        missed &= through[inside] == 0
        inside, ranges = inside[missed], ranges[missed]
        from_eye = columns[:, inside].T - frames.transform(T, scan.eye)
        through[inside[np.einsum("ij,ij->i", normals[inside], from_eye) < -_FACING * ranges]] = 2
        return through


def range_images(scans: Sequence[Scan], kept: Sequence[Mask], cell: float) -> RangeImages:
    """Return what each view saw along every ray, so that a place can be told through which a view looked.

    Rays of all views are mapped stereographically about their mean; bins are as large as the scans' angular spacing.

    Args:
        kept: per scan a mask of the points that count.
        cell: smallest edge of a bin at the median range, length_unit.
    """
    views = list(zip(scans, kept, strict=True))
    middles, ranges = zip(*parallel(_middle_and_ranges, views), strict=True)
    axes = _axes_about(np.sum(middles, axis=0))
    # The rays of few views at a time, which are made again: those of hundreds are hundreds of megabytes.
    maps = list(parallel(partial(_stereographic_map, axes), views))
    # In the middle of the map a length is half the angle: hence the half.
    angle = np.sqrt(np.median([scan.solid_angle for scan in scans]))
    size = max(_BIN * angle, cell / float(np.median(np.concatenate(ranges)))) / 2
    # A margin of two bins, so that every occupied bin has all its neighbours.
    low = np.min([m.min(axis=0) for m in maps], axis=0) - 2 * size
    shape = tuple(((np.max([m.max(axis=0) for m in maps], axis=0) - low) / size).astype(int) + 3)
    images = list(parallel(partial(_range_image, low, size, shape), zip(maps, ranges, strict=True)))
    least, filled = map(np.array, zip(*parallel(_of_nine_bins, images), strict=True))
    occupied = np.isfinite(images)
    eyes = zip(images, maps, ranges, strict=True)
    limits = np.array([np.quantile(of_view, (_STRAY, 1 - _STRAY)) for of_view in ranges])
    return RangeImages(
        axes=axes,
        low=low,
        bin=size,
        nearest=np.where(occupied & (filled >= _CLOSED), least, -np.inf),
        empty=filled == 0,
        field=occupied.sum(axis=0) >= 2,
        reach=(float(limits[:, 0].min()), float(limits[:, 1].max())),
        trusted=np.array([_looked_from_one_eye(image, low, size, m, of_view) for image, m, of_view in eyes]),
    )


def _rays(scan: Scan, keep: Mask) -> tuple[Array, Array]:
    """Return ranges (N,) and unit directions (N, 3), scanner frame, from the eye to the points that count."""
    from_eye = scan.points.compress(keep, axis=0) - scan.eye
    ranges = np.linalg.norm(from_eye, axis=1)
    return ranges, from_eye / ranges[:, None]


def _middle_and_ranges(view: tuple[Scan, Mask]) -> tuple[Array, Array]:
    """Return the mean direction (3,) and the ranges (N,) of a view's rays."""
    ranges, directions = _rays(*view)
    return centroid(directions), ranges


def _stereographic_map(axes: Array, view: tuple[Scan, Mask]) -> Array:
    """Return the stereographic map (N, 2) of a view's rays: a length is the tangent of half the angle to the middle.

    What lies behind the scanner lies far off.

    Args:
        axes: (3, 3) rows: across, up, and the middle, scanner frame.
    """
    x = _rays(*view)[1] @ axes.T
    return x[:, :2] / np.maximum(1 + x[:, 2:], _BEHIND)


def _axes_about(middle: Array) -> Array:
    """Return axes (3, 3), rows across, up and ahead, the last along `middle` (3,)."""
    ahead = middle / max(float(np.linalg.norm(middle)), 1e-300)
    across = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(ahead, across), ahead])


def _range_image(low: Array, size: float, shape: tuple[int, ...], rays: tuple[Array, Array]) -> Array:
    """Return the least range (H, W) of a view's rays in each bin, inf where there is none.

    Args:
        low: (2,) corner of the grid on the map.
        size: edge of a bin.
        shape: H, W.
        rays: their map (N, 2) and ranges (N,).
    """
    on_map, ranges = rays
    i, j = ((on_map - low) / size).astype(np.int64).T
    image = np.full(shape, np.inf)
    # Of several rays in a bin the last one that is written remains: the nearest.
    order = np.argsort(-ranges)
    image[i[order], j[order]] = ranges[order]
    return image


def _looked_from_one_eye(image: Array, low: Array, size: float, on_map: Array, ranges: Array) -> bool:
    """Return False where much of a view lies behind its own surface: it holds scans from several places.

    Args:
        image: (H, W) of the view (`_range_image`), over the grid of `low` and `size`.
        on_map, ranges: (N, 2) and (N,) of the view's rays.
    """
    i, j = ((on_map - low) / size).astype(np.int64).T
    # A bin is 2 · size wide as an angle.
    behind = ranges > image[i, j] + _STEEPEST * 2 * size * ranges
    return bool(np.mean(behind) < _MOST_BEHIND)


def _of_nine_bins(image: Array) -> tuple[Array, Indices]:
    """Return the least value (H, W) of each bin and its eight neighbours, and how many of the nine are finite."""
    padded = np.pad(image, 1, constant_values=np.inf)
    shifted = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    least, filled = np.full(image.shape, np.inf), np.zeros(image.shape, np.int64)
    for i, j in np.ndindex(3, 3):
        least = np.minimum(least, shifted[:, :, i, j])
        filled += np.isfinite(shifted[:, :, i, j])
    return least, filled
