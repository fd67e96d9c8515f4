"""Calibration spheres: one on a stem, and several on a plate."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray

from data_synth.shapes.solid import circle, extrude, from_arrays, polygon, rounded, to_mesh, union, warp

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sphere:
    """Lengths in mm. Part frame: origin at the sphere's centre, the stem along −z."""

    radius: float = 30.0
    tolerance: float = 1e-3  # largest distance of a facet from the sphere, inside or outside
    stem_radius: float = 6.0
    stem_length: float = 50.0  # from the sphere's surface to the foot
    foot_radius: float = 18.0
    foot_height: float = 8.0


@dataclass(frozen=True)
class SpherePlate:
    """Lengths in mm. Part frame: origin in the middle of the plate's top, z out of it."""

    radius: float = 15.0
    tolerance: float = 1.5e-3
    positions: tuple[tuple[float, float], ...] = ((-100, -60), (105, -65), (95, 70), (-90, 55), (0, 5))
    # Unequal heights: with all centres in one plane a mirrored fit would pass for a good one.
    heights: tuple[float, ...] = (30.0, 45.0, 35.0, 60.0, 80.0)
    length: float = 260.0
    width: float = 180.0
    thickness: float = 12.0
    stem_radius: float = 4.0


def build(sphere: Sphere = Sphere()) -> trimesh.Trimesh:
    """One closed mesh of sphere, stem and foot."""
    bottom = -sphere.radius - sphere.stem_length
    stem = extrude(circle(sphere.stem_radius), bottom, -sphere.radius / 2)
    foot = extrude(circle(sphere.foot_radius), bottom, bottom + sphere.foot_height)
    return to_mesh(union([ball(sphere.radius, sphere.tolerance), stem, foot]))


def build_plate(plate: SpherePlate = SpherePlate()) -> trimesh.Trimesh:
    """One closed mesh of a plate with spheres on stems."""
    x, y = plate.length / 2, plate.width / 2
    base = rounded(polygon([(-x, -y), (x, -y), (x, y), (-x, y)]), outer=10.0)
    solids = [extrude(base, -plate.thickness, 0.0)]
    for centre in centres(plate):
        solids.append(extrude(circle(plate.stem_radius, centre[:2]), -1.0, centre[2] - plate.radius / 2))
        solids.append(ball(plate.radius, plate.tolerance).translate(tuple(centre)))
    return to_mesh(union(solids))


def centres(plate: SpherePlate) -> Array:
    """(N, 3) centres of the plate's spheres in mm, part frame. Raises ValueError for unequal counts."""
    if len(plate.positions) != len(plate.heights):
        raise ValueError(f"{len(plate.positions)} positions but {len(plate.heights)} heights")
    return np.column_stack([plate.positions, plate.heights]).astype(np.float64)


@cache
def ball(radius: float, tolerance: float) -> Manifold:
    """A sphere in mm whose facets lie within ± tolerance of it, with its centre at the origin.

    An icosahedron's faces, divided n times along each edge, are blown up to the sphere. The largest
    triangles come to lie in the middle of a face: edge e = 1.0515/(0.7947 n) radii, circumradius e/√3,
    depth e²/6. Vertices outside and facets' middles inside share it evenly. Raises ValueError for a
    tolerance that would need more than 400 000 triangles.
    """
    divisions = int(np.ceil(np.sqrt((1.0515 / 0.7947) ** 2 / 12 * radius / tolerance)))
    if 20 * divisions**2 > 400_000:
        raise ValueError(f"radius {radius} mm within {tolerance} mm needs more than 400 000 triangles")
    depth = (1.0515 / 0.7947 / divisions) ** 2 / 6
    corners = trimesh.creation.icosahedron()
    faceted = from_arrays(corners.vertices, corners.faces).refine(max(divisions, 1))
    outwards = radius * (1 + depth / 2)
    return warp(faceted, lambda points: points * (outwards / np.linalg.norm(points, axis=1, keepdims=True)))
