"""Calibration spheres: one on a stem, and several on a plate."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray

from data_synth.shapes.solid import extrude, from_arrays, polygon, rounded, to_mesh, union

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
    tolerance: float = 2e-3
    positions: tuple[tuple[float, float], ...] = ((-100, -60), (105, -65), (95, 70), (-90, 55), (0, 5))
    # Unequal heights: with all centres in one plane a mirrored fit would pass for a good one.
    heights: tuple[float, ...] = (30.0, 45.0, 35.0, 60.0, 80.0)
    length: float = 260.0
    width: float = 180.0
    thickness: float = 12.0
    stem_radius: float = 4.0


def build(sphere: Sphere = Sphere()) -> trimesh.Trimesh:  # noqa: B008  (frozen, hence safe as a default)
    """One closed mesh of sphere, stem and foot."""
    bottom = -sphere.radius - sphere.stem_length
    return to_mesh(
        union(
            [
                ball(sphere.radius, sphere.tolerance),
                Manifold.cylinder(-bottom - sphere.radius / 2, sphere.stem_radius, -1.0, 96).translate((0, 0, bottom)),
                Manifold.cylinder(sphere.foot_height, sphere.foot_radius, -1.0, 96).translate((0, 0, bottom)),
            ]
        )
    )


def build_plate(plate: SpherePlate = SpherePlate()) -> trimesh.Trimesh:  # noqa: B008
    """One closed mesh of a plate with spheres on stems."""
    x, y = plate.length / 2, plate.width / 2
    base = rounded(polygon([(-x, -y), (x, -y), (x, y), (-x, y)]), outer=10.0)
    solids = [extrude(base, -plate.thickness, 0.0)]
    for centre in centres(plate):
        stem = Manifold.cylinder(centre[2] - plate.radius / 2 + 1, plate.stem_radius, -1.0, 64)
        solids.append(stem.translate((centre[0], centre[1], -1.0)))
        solids.append(ball(plate.radius, plate.tolerance).translate(tuple(centre)))
    return to_mesh(union(solids))


def centres(plate: SpherePlate) -> Array:
    """(N, 3) centres of the plate's spheres in mm, part frame. Raises ValueError for unequal counts."""
    if len(plate.positions) != len(plate.heights):
        raise ValueError(f"{len(plate.positions)} positions but {len(plate.heights)} heights")
    return np.column_stack([plate.positions, plate.heights]).astype(np.float64)


@cache
def ball(radius: float, tolerance: float) -> Manifold:
    """An icosphere in mm whose facets lie within ± tolerance of the sphere.

    Vertices lie outside and facets' middles inside by the same amount, hence the factor. Raises
    ValueError for a tolerance that would need more than 330 000 triangles.
    """
    for subdivisions in range(3, 8):
        mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
        # A facet comes nearest to the centre at the foot of the perpendicular.
        nearest = float(np.einsum("ij,ij->i", mesh.triangles[:, 0], mesh.face_normals).min())
        scale = 2.0 / (1.0 + nearest)
        if radius * (scale - 1.0) <= tolerance:
            return from_arrays(mesh.vertices * radius * scale, mesh.faces)
    raise ValueError(f"a sphere of radius {radius} mm within {tolerance} mm needs more than 330 000 triangles")
