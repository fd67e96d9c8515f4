"""Smooth errors along the ray of a scanner, over its field and over incidence, and what they do to the overlaps."""

import numpy as np
from numpy.polynomial import legendre

from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement
from stitch.model.point_slopes import PointSlopes
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.point_gram import PointGram, streamed

# Errors that views have for themselves are as smooth as DEGREE; those that all share may be finer.
DEGREE, FINER = 3, 6
# Corners are seen by few points.
_REACH = 0.98


def smooth_sums(
    measurement: Measurement, freed: FreePoses, beside: PointSlopes | None = None, apart: bool = False
) -> tuple[PointGram, float]:
    """Sums of K smooth errors of unit size along the ray, then of what is beside them, and the noise; NaN without
    scans.

    The last of the K is over incidence, the others are over the field.

    Args:
        apart: for either view of a pair its own, and finer ones too, after those of DEGREE.
    """
    capture, half = measurement.capture, _half_field(measurement)
    degree = FINER if apart else DEGREE
    further = beside or PointSlopes(measurement, ())

    def of_points(v: int, index: Indices) -> Array:
        scan = capture.scans[v]
        smooth = _undone(scan.points[index] - scan.eye, measurement.scan_views[v].cosine[index], half, degree)
        return np.concatenate([smooth, further.at(v, freed.poses[v], index)])

    def of_targets() -> Array:
        assert capture.sightings is not None
        points = capture.sightings.points
        seen = capture.sightings.target >= 0
        # An empty slot has no ray; nobody knows at what slant a target was seen.
        flat = np.where(seen[..., None], points, [0.0, 0.0, 1.0]).reshape(-1, 3)
        moved = _undone(flat, np.ones(len(flat)), half, degree).reshape(-1, *points.shape)
        smooth = np.where(seen[..., None], moved, 0.0)
        return np.concatenate([smooth, further.at_targets(freed.poses)])

    sums = streamed(freed, capture.noise_factor, of_points, of_targets, apart)
    return sums, float(np.nanmedian([scan.noise for scan in capture.scans]))


def _half_field(measurement: Measurement) -> Array:
    """(2,) x/z and y/z up to which the scanner sees."""
    away = np.concatenate([scan.points - scan.eye for scan in measurement.capture.scans])
    slopes = np.abs(away[:, :2] / away[:, 2:])
    return np.asarray(np.maximum(np.quantile(slopes, _REACH, axis=0), 1e-6))


def orders(degree: int) -> list[tuple[int, int]]:
    """Of the smooth errors over the field, coarse ones first."""
    every = [(i, j) for i in range(degree + 1) for j in range(degree + 1) if 0 < i + j <= degree]
    return sorted(every, key=sum)


def size_of_orders(degree: int) -> Array:
    """(K,) rms of each; those of DEGREE have unit rms together."""
    sizes = np.array([1.0 / (i + j) for i, j in orders(degree)])
    return np.asarray(sizes / np.linalg.norm(sizes[: len(orders(DEGREE))]))


def _undone(away: Array, cosine: Array, half: Array, degree: int) -> Array:
    """(K, N, 3) what undoes smooth errors along the rays (N, 3) from the scanner's eye to its points, per unit.

    Legendre products over the field, those of DEGREE of unit rms together, and the slope with incidence.
    """
    a, b = np.clip(away[:, :2] / away[:, 2:] / half, -1.2, 1.2).T
    powers = [legendre.legvander(x, degree) * np.sqrt(2 * np.arange(degree + 1) + 1) for x in (a, b)]
    sizes = zip(size_of_orders(degree), orders(degree), strict=True)
    smooth = [size * powers[0][:, i] * powers[1][:, j] for size, (i, j) in sizes]
    rays = away / np.linalg.norm(away, axis=1)[:, None]
    return np.asarray(-np.array([*smooth, 1 / cosine - 1])[..., None] * rays)
