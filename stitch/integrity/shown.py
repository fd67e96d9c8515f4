"""What a scan shows of points that lie, or should lie, on the surface that it has seen."""

import numpy as np
from numpy.typing import NDArray

from stitch.frames import Array, Indices, Mask
from stitch.measurement.scan import Scan

# The same side of a part: normals within 45°; at the same place: within two spacings along the surface.
_SAME_SIDE, _SPACINGS = np.cos(np.radians(45.0)), 2.0
# Elsewhere is farther than so many tolerances: what a lens or a slant does to a scan moves it by less.
_OFF_SURFACE_TOLERANCES = 3.0

# Per point what a scan shows of it: 2 in its place, 1 elsewhere, 0 nothing, or neither.
PointVisibility = NDArray[np.int8]


def classify_visibility(scan: Scan, points: Array, normals: Array, limits: tuple[float, float]) -> PointVisibility:
    """(n,) what a scan shows of points (n, 3) with normals (n, 3), in its frame.

    Args:
        limits: distance along the normal that is the same place, and how far is looked, length_unit.
    """
    tolerance, reach = limits
    _, along, beside = nearest_partners(scan, points, normals, reach)
    found, away = beside < _SPACINGS * scan.spacing, np.abs(along) / tolerance
    return np.asarray(2 * (found & (away < 1)) + (found & (away > _OFF_SURFACE_TOLERANCES)), np.int8)


def points_in_place(scan: Scan, points: Array, normals: Array, tolerance: float) -> Mask:
    """(n,) bool: points that a scan shows where they are, however sparse it is there."""
    reach = float(np.sqrt(scan.area.max())) * _SPACINGS + tolerance
    index, along, beside = nearest_partners(scan, points, normals, reach)
    return np.asarray((np.abs(along) < tolerance) & (beside < _SPACINGS * np.sqrt(scan.area[index])))


def nearest_partners(scan: Scan, points: Array, normals: Array, reach: float) -> tuple[Indices, Array, Array]:
    """Of points in its frame the nearest one of a scan (n,), and how far they are from it (n,) along and beside its
    normal: infinitely far beside where it is none, or of the other side of the part."""
    distance, partner = scan.tree.query(np.ascontiguousarray(points), distance_upper_bound=reach)
    found = np.isfinite(distance)
    partner = np.where(found, partner, 0).astype(np.int64)
    own = scan.normals[partner]
    along = np.einsum("ni,ni->n", points - scan.points[partner], own)
    found &= scan.usable[partner] & (np.einsum("ni,ni->n", normals, own) > _SAME_SIDE)
    beside = np.sqrt(np.maximum(distance**2 - along**2, 0.0), where=found, out=np.full(len(points), np.inf))
    return partner, along, beside
