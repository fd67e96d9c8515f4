"""What a scanner would see of a surface from a pose: points in its field that face it, and nothing before them."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices, Mask
from stitch.measurement.scan import GRAZING_COSINE
from stitch.planning.planned_part import PlannedPart

# A ray is as wide as so many distances between the points; what lies so many rays' widths behind another is hidden.
_RAY, _BEHIND = 2.0, 4.0
# Cosine to the optical axis beyond which no scanner sees.
_AHEAD = 0.3


@dataclass(frozen=True)
class FieldOfView:
    """Where a scanner sees: slopes x/z and y/z up to `half` (2,), distances from `near` to `far`, along `axis` (3,)."""

    half: Array
    near: float
    far: float
    standoff: float
    axis: Array


def expected_scan(part: PlannedPart, T_reference_scanner: Array, field: FieldOfView) -> Indices:
    """Indices of the part's points that the scanner sees.

    Args:
        part: in the reference frame.
        T_reference_scanner: (4, 4).
    """
    T = frames.inverse(T_reference_scanner)
    points = frames.transform(T, part.points)
    # What lies behind the scanner, or beside it, has no slope.
    ahead = np.flatnonzero(points @ field.axis > _AHEAD * np.linalg.norm(points, axis=1))
    if not len(ahead):
        return ahead
    points, normals = points[ahead], frames.rotate(T, part.normals[ahead])
    slopes, reach = points[:, :2] / (points @ field.axis)[:, None], np.linalg.norm(points, axis=1)
    cosine = -np.einsum("ij,ij->i", points, normals) / reach
    inside = (np.abs(slopes) <= field.half).all(axis=1) & (reach > field.near) & (reach < field.far)
    return np.asarray(ahead[inside & (cosine > GRAZING_COSINE) & ~_is_occluded(slopes, reach)])


def _is_occluded(slopes: Array, reach: Array) -> Mask:
    """(N,) bool: another point lies in the same ray, well before it."""
    area = max(float(np.prod(np.ptp(slopes, axis=0))), 1e-12)
    ray = _RAY * np.sqrt(area / len(slopes))
    cells = np.floor(slopes / ray).astype(np.int64)
    cells -= cells.min(axis=0)
    number = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    nearest = np.full(number.max() + 1, np.inf)
    np.minimum.at(nearest, number, reach)
    return np.asarray(reach > nearest[number] + _BEHIND * ray * nearest[number])
