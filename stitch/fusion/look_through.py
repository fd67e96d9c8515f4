"""Which places views look through: they measured a surface behind them, or nothing where they ought to have.

A range image per view, all over the same field of the scanner: a stereographic map of the rays, whose bins hold the
nearest surface. What stands before the nearest of nine bins stands where the view saw past.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.session.scan import Scan, centroid
from stitch.system.threads import parallel

# Edge of a bin in spacings between rays: few bins of a surface stay empty.
_BIN = 1.5
# Bins of nine that show a surface, where it counts as seen and closed.
_CLOSED = 6
# A surface is steep: along 80° it goes so many bins deep across one. What lies deeper in one ray lies behind another.
_STEEPEST = 6.0
# A view of which more lies behind its own surfaces did not look from its eye, as several scans in one file.
_MOST_BEHIND = 0.1
# What lies behind the scanner lies far off on the map.
_BEHIND = 1e-3
# A surface that faces a view within 60° is seen by it.
_FACING = 0.5


@dataclass(frozen=True)
class RangeImages:
    """The field of a scanner in bins, and what each view saw in it."""

    axes: Array  # (3, 3) rows: across, up, and the middle of the field, scanner frame
    low: Array  # (2,) corner of the field on the map
    bin: float
    nearest: Array  # (V, H, W) range of the nearest surface in nine bins, −inf where there is no closed one
    empty: Mask  # (V, H, W): nothing in nine bins
    field: Mask  # (H, W): two views or more measured something
    reach: tuple[float, float]  # ranges that were measured
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
        away = frames.transform(frames.inverse(T), centres) - scan.eye
        far = np.linalg.norm(away, axis=1)
        # On the map lengths are tangents of half the angles to the middle of the field.
        corners = np.abs(np.stack([self.low, self.low + self.bin * np.array(self.field.shape)]))
        field = 2 * np.arctan(np.linalg.norm(corners.max(axis=0)))
        cosine = away @ self.axes[2] / np.maximum(far, 1e-300)
        inside = np.arccos(np.clip(cosine, -1, 1)) <= field + np.arcsin(np.minimum(radii / np.maximum(far, 1e-300), 1))
        farthest = max(float(self.nearest.max()), self.reach[1])
        return (far <= radii) | (inside & (far - radii <= farthest))

    def views_through(self, scan: Scan, T: Array, v: int, columns: Array, normals: Array, margin: float) -> Indices:
        """Return per place (N,) 1 where view v measured a surface behind it, 2 where it ought to have seen it, else 0.

        2: the place faces the view, lies within the measured ranges, and the view measured nothing around its ray. A
        view that did not look from one eye (`trusted`) says nothing.

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
        turn = self.axes @ T[:3, :3].T
        shift = -turn @ T[:3, 3] - self.axes @ scan.eye
        across, up, ahead = (a * x + b * y + c * z + d for (a, b, c), d in zip(turn, shift, strict=True))
        far = np.sqrt(across**2 + up**2 + ahead**2)
        scale = self.bin * np.maximum(far + ahead, _BEHIND * far)
        i, j = across / scale - self.low[0] / self.bin, up / scale - self.low[1] / self.bin
        inside = np.flatnonzero((i >= 0) & (i < self.field.shape[0]) & (j >= 0) & (j < self.field.shape[1]))
        far, i, j = far[inside], i[inside].astype(np.int64), j[inside].astype(np.int64)
        through[inside[self.nearest[v, i, j] > far + margin]] = 1
        missed = self.empty[v, i, j] & self.field[i, j] & (far > self.reach[0]) & (far < self.reach[1])
        missed &= through[inside] == 0
        inside, far = inside[missed], far[missed]
        away = columns[:, inside].T - frames.transform(T, scan.eye)
        through[inside[np.einsum("ij,ij->i", normals[inside], away) < -_FACING * far]] = 2
        return through


def range_images(scans: Sequence[Scan], kept: Sequence[Mask], cell: float) -> RangeImages:
    """Return the range images of all views over one common map of the scanner's field.

    Rays are mapped stereographically about the mean ray of all views; bins are as large as the scans' angular spacing.

    Args:
        kept: per scan a mask of the points that count.
        cell: smallest edge of a bin at the median range, length_unit.
    """

    def rays(scan: Scan, keep: Mask) -> tuple[Array, Array]:
        """Return ranges (N,) and unit directions (N, 3), scanner frame, from the eye."""
        away = scan.points.compress(keep, axis=0) - scan.eye
        far = np.linalg.norm(away, axis=1)
        return far, away / far[:, None]

    def middle_and_ranges(item: tuple[Scan, Mask]) -> tuple[Array, Array]:
        far, direction = rays(*item)
        return centroid(direction), far

    # The rays of few views at a time: those of hundreds are hundreds of megabytes.
    views = list(zip(scans, kept, strict=True))
    middles, ranges = zip(*parallel(middle_and_ranges, views), strict=True)
    axes = _axes_about(np.sum(middles, axis=0))

    def on_map(item: tuple[Scan, Mask]) -> Array:
        """(N, 2) stereographic map of a view's rays; what lies behind the scanner lies far off."""
        x = rays(*item)[1] @ axes.T
        return x[:, :2] / np.maximum(1 + x[:, 2:], _BEHIND)

    maps = list(parallel(on_map, views))
    # In the middle of the map a length is half the angle: hence the halves.
    angle = np.sqrt(np.median([scan.solid_angle for scan in scans]))
    size = max(_BIN * angle, cell / float(np.median(np.concatenate(ranges)))) / 2
    low = np.min([m.min(axis=0) for m in maps], axis=0) - 2 * size
    shape = tuple(((np.max([m.max(axis=0) for m in maps], axis=0) - low) / size).astype(int) + 3)

    def image_of(item: tuple[Array, Array]) -> tuple[Array, Mask, bool, Mask]:
        """Return one view's nearest range, empty bins, whether it is trusted, and occupied bins (H, W), from its rays.

        The nearest range is that of nine bins, −inf where fewer than `_CLOSED` of them are occupied. A view is not
        trusted if much of it lies behind its own surface: it did not look from one eye.
        """
        m, far = item
        i, j = ((m - low) / size).astype(np.int64).T
        image = np.full(shape, np.inf)
        order = np.argsort(-far)
        image[i[order], j[order]] = far[order]
        least, filled = _of_nine_bins(image)
        occupied = np.isfinite(image)
        trusted = np.mean(far > image[i, j] + 2 * _STEEPEST * size * far) < _MOST_BEHIND
        return np.where(occupied & (filled >= _CLOSED), least, -np.inf), filled == 0, bool(trusted), occupied

    answers = parallel(image_of, zip(maps, ranges, strict=True))
    nearest, empty, trusted, occupied = map(np.array, zip(*answers, strict=True))
    limits = np.array([np.quantile(far, (0.01, 0.99)) for far in ranges])
    reach = float(limits[:, 0].min()), float(limits[:, 1].max())
    return RangeImages(axes, low, size, nearest, empty, field=occupied.sum(axis=0) >= 2, reach=reach, trusted=trusted)


def _axes_about(middle: Array) -> Array:
    ahead = middle / max(float(np.linalg.norm(middle)), 1e-300)
    across = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(ahead, across), ahead])


def _of_nine_bins(image: Array) -> tuple[Array, Indices]:
    """Return the least value (H, W) of each bin and its eight neighbours, and how many of the nine are finite."""
    padded = np.pad(image, 1, constant_values=np.inf)
    shifted = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    least, filled = np.full(image.shape, np.inf), np.zeros(image.shape, np.int64)
    for i, j in np.ndindex(3, 3):
        least = np.minimum(least, shifted[:, :, i, j])
        filled += np.isfinite(shifted[:, :, i, j])
    return least, filled
