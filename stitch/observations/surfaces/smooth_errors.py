"""Smooth errors of a scanner, over its field and over incidence, and what they do to the overlaps."""

import numpy as np
from numpy.polynomial import legendre

from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement
from stitch.model.point_slopes import PointSlopes
from stitch.observations.surfaces.free_poses import UnconstrainedPoses
from stitch.observations.surfaces.point_gram import PointGram, stream_point_sums

# Along the ray; finer ones only where views may have errors for themselves, which are not to explain what all share.
_DEGREE, _FINE_DEGREE = 3, 6
# Corners are seen by few points.
_FIELD_QUANTILE = 0.98
_LEGENDRE_ORDERS = sorted(
    ((i, j) for i in range(_FINE_DEGREE + 1) for j in range(_FINE_DEGREE + 1) if 0 < i + j <= _FINE_DEGREE), key=sum
)
# Along the ray over the field, coarse ones first; the slope with incidence follows them.
COARSE = sum(sum(order) <= _DEGREE for order in _LEGENDRE_ORDERS)
# With the finer ones, which come first of what all views may have in common besides.
FINE = len(_LEGENDRE_ORDERS)


def sum_smooth_errors(
    measurement: Measurement,
    unconstrained: UnconstrainedPoses,
    point_effects: PointSlopes | None = None,
    per_view: bool = False,
) -> tuple[PointGram, float]:
    """Sums of smooth errors of unit size, then of what is beside them, and the noise; NaN without scans.

    The first are COARSE, along the ray over the field, and one over incidence.

    Args:
        per_view: those of COARSE for either view of a pair its own; and after the one over incidence `shared_errors`.
    """
    capture, half = measurement.capture, half_field(measurement)
    further = point_effects or PointSlopes(measurement, ())
    standoff = float(np.median(np.concatenate([np.linalg.norm(s.points - s.eye, axis=1) for s in capture.scans])))

    def corrections(away: Array, cosine: Array) -> Array:
        own = _smooth_corrections(away, cosine, half)
        return np.concatenate([own, _shared_shapes(away, half, standoff)]) if per_view else own

    def of_points(v: int, index: Indices) -> Array:
        scan = capture.scans[v]
        smooth = corrections(scan.points[index] - scan.eye, measurement.scan_views[v].cosine[index])
        return np.concatenate([smooth, further.at(v, unconstrained.poses[v], index)])

    def of_targets() -> Array:
        assert capture.sightings is not None
        points = capture.sightings.points
        seen = capture.sightings.target >= 0
        # An empty slot has no ray; nobody knows at what slant a target was seen.
        flat = np.where(seen[..., None], points, [0.0, 0.0, 1.0]).reshape(-1, 3)
        moved = corrections(flat, np.ones(len(flat))).reshape(-1, *points.shape)
        smooth = np.where(seen[..., None], moved, 0.0)
        return np.concatenate([smooth, further.at_targets(unconstrained.poses)])

    sums = stream_point_sums(unconstrained, capture.noise_factor, of_points, of_targets, COARSE if per_view else 0)
    return sums, float(np.nanmedian([scan.noise for scan in capture.scans]))


def half_field(measurement: Measurement) -> Array:
    """(2,) |x/z| and |y/z| in the scanner's frame up to which it sees, but for the corners."""
    away = np.concatenate([scan.points - scan.eye for scan in measurement.capture.scans])
    slopes = np.abs(away[:, :2] / away[:, 2:])
    return np.asarray(np.maximum(np.quantile(slopes, _FIELD_QUANTILE, axis=0), 1e-6))


def _smooth_corrections(away: Array, cosine: Array, half: Array) -> Array:
    """(COARSE + 1, N, 3) what undoes smooth errors along the rays (N, 3) from the scanner's eye, per unit.

    Legendre products over the field, of unit rms together, and the slope with incidence.
    """
    along = [*legendre_products(away, half, _DEGREE), 1 / cosine - 1]
    return np.asarray(-np.array(along)[..., None] * _unit_vectors(away))


def _shared_shapes(away: Array, half: Array, standoff: float) -> Array:
    """(S, N, 3) what all views may have in common besides: finer over the field, along the range, and across the ray.

    Each is about as large as the others; scanners of bad axes or a bent scale are among them.
    """
    ray = _unit_vectors(away)
    far = np.linalg.norm(away, axis=1) / standoff - 1
    a, b = away[:, :2].T / away[:, 2] / half[:, None]
    along = [*legendre_products(away, half)[COARSE:], far, far**2, far**3, far * a, far * b]
    across = [shape[:, None] * axis for shape in (a, b, a**2, a * b, b**2, far) for axis in np.eye(3)[:2]]
    return np.concatenate([np.array(along)[..., None] * ray, np.array(across)])


def legendre_products(away: Array, half: Array, degree: int = _FINE_DEGREE) -> list[Array]:
    """FINE Legendre products (N,) over the field for rays (N, 3); the first COARSE have unit rms together.

    Args:
        half: (2,) of `half_field`, where the products end.
    """
    a, b = np.clip(away[:, :2] / away[:, 2:] / half, -1.2, 1.2).T
    powers = [legendre.legvander(x, degree) * np.sqrt(2 * np.arange(degree + 1) + 1) for x in (a, b)]
    unit = np.sqrt(sum(1.0 / sum(order) ** 2 for order in _LEGENDRE_ORDERS[:COARSE]))
    return [powers[0][:, i] * powers[1][:, j] / ((i + j) * unit) for i, j in _LEGENDRE_ORDERS if i + j <= degree]


def _unit_vectors(away: Array) -> Array:
    return np.asarray(away / np.linalg.norm(away, axis=1)[:, None])
