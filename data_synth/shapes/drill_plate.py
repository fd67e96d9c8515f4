"""A plate with a grid of drilled holes, flat or curved."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from data_synth.shapes.solid import circle, extrude, polygon, refined, rounded, to_mesh, warp

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DrillPlate:
    """Lengths in mm.

    Part frame: origin in the middle of the drilled face, z out of it, x along the length. With a
    radius the face is a cylinder about an axis parallel to x, and every hole follows its normal.
    """

    length: float = 200.0
    width: float = 160.0
    thickness: float = 8.0
    columns: int = 3  # of holes, along x
    rows: int = 3
    pitch: float = 50.0
    hole_diameter: float = 10.0
    corner_radius: float = 8.0
    hole_sides: int = 128  # corners on the true circle; facets lie 1.5 µm inside at 10 mm
    radius: float | None = None
    facet: float = 4.0  # longest edge of a curved plate: facets leave the cylinder by facet²/(8·radius)


@dataclass(frozen=True)
class CurvedDrillPlate(DrillPlate):
    """A plate as it lies on a curved structure; see DrillPlate."""

    radius: float | None = 600.0


def build(plate: DrillPlate = DrillPlate()) -> trimesh.Trimesh:
    """One closed mesh. Raises ValueError where the holes do not fit on the plate."""
    x, y = plate.length / 2, plate.width / 2
    places = _places(plate)
    if (np.abs(places).max(axis=0) + plate.hole_diameter / 2 >= (x, y)).any():
        raise ValueError(f"{plate.columns} × {plate.rows} holes at {plate.pitch} mm reach over the edge")
    outline = rounded(polygon([(-x, -y), (x, -y), (x, y), (-x, y)]), plate.corner_radius)
    for place in places:
        outline -= circle(plate.hole_diameter / 2, place, plate.hole_sides)
    solid = extrude(outline, -plate.thickness, 0.0)
    if (radius := plate.radius) is not None:
        solid = warp(refined(solid, plate.facet), lambda points: _bend(points, radius))
    return to_mesh(solid)


def holes(plate: DrillPlate) -> tuple[Array, Array]:
    """Centres (N, 3) in the drilled face in mm and unit axes (N, 3) out of it, part frame, row by row."""
    places = _places(plate)
    flat = np.column_stack([places, np.zeros(len(places))])
    above = flat + np.array([0.0, 0.0, 1.0])
    if plate.radius is None:
        return flat, above - flat
    return _bend(flat, plate.radius), _bend(above, plate.radius) - _bend(flat, plate.radius)


def _places(plate: DrillPlate) -> Array:
    x, y = (plate.pitch * (np.arange(n) - (n - 1) / 2) for n in (plate.columns, plate.rows))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _bend(points: Array, radius: float) -> Array:
    """Roll the plane z = 0 onto a cylinder through the origin; lengths in the face are kept."""
    angle = points[:, 1] / radius
    distance = radius + points[:, 2]
    return np.column_stack([points[:, 0], distance * np.sin(angle), distance * np.cos(angle) - radius])
