"""A side of a car body: pillars, roof rail and sill around a door that hangs in its hinges."""

from dataclasses import dataclass

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold

from data_synth.shapes.car_door import CarDoor, door_outline, outer_surface, solid, tray
from data_synth.shapes.solid import polygon, rounded, to_mesh, union

_HINGES = (0.17, 0.47)  # heights, in shares of the door's
_HINGE = np.array([60.0, 9.0, 70.0])  # its size


@dataclass(frozen=True)
class BodySide(CarDoor):
    """The door and what stands around it; lengths in mm, the door's part frame."""

    seam: float = 4.5  # between door and body, all round
    pillar: float = 95.0  # width of the pillars before and behind the door, and of the roof rail
    sill: float = 150.0  # height of the sill under the door


def build(body: BodySide = BodySide()) -> trimesh.Trimesh:
    """One closed mesh of frame, door and hinges."""
    margin = body.seam + max(body.pillar, body.sill) + 10.0
    return to_mesh(union([solid(body), tray(body, _frame(body), margin), *_hinges(body)]))


def _frame(body: BodySide) -> CrossSection:
    """Pillars, roof rail and sill in the x-z plane, without the door's opening."""
    door, wide = door_outline(body), body.seam + body.pillar
    low, high = -body.seam - body.sill, 0.12 * body.height
    sill = polygon([(-wide, low), (body.length + wide, low), (body.length + wide, high), (-wide, high)])
    around = door.offset(wide, circular_segments=96) + sill
    return rounded(around, outer=40.0) - door.offset(body.seam, circular_segments=96)


def _hinges(body: BodySide) -> list[Manifold]:
    """Blocks behind the sheet that reach from the front pillar into the door."""
    outline = np.asarray(max(door_outline(body).to_polygons(), key=len), float)
    blocks = []
    for share in _HINGES:
        z = share * body.height
        front = outline[outline[:, 0] < body.length / 2]
        x = float(front[np.abs(front[:, 1] - z).argmin(), 0]) - body.seam / 2
        behind = float(outer_surface(body, np.array(x), np.array(z))) - body.flange
        blocks.append(Manifold.cube(tuple(_HINGE), True).translate((x, behind, z)))
    return blocks
