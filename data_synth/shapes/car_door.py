"""The outer part of a car door: a curved sheet with flanges round its edge and its window, and the pane."""

from dataclasses import dataclass

import manifold3d
import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from data_synth.shapes.solid import circle, extrude, polygon, rounded, slab, to_mesh, union

Array = NDArray[np.float64]
HANDLE = np.array([0.845, 0.495])  # middle of the recess, in shares of length and height
_RECESS = np.array([88.0, 38.0])  # its half axes
_SHOULDER, _SILL = 0.435, 0.16  # heights of the two creases, in shares of the height


@dataclass(frozen=True)
class CarDoor:
    """Lengths in mm, radii of curvature of the outer surface too.

    Part frame: x from the front of the car to its rear, y outwards, z up; the origin lies at the
    outline's lower front corner, on the tangent plane of the outer surface. Facets leave the surface by
    less than 6 µm, in the handle's recess by up to 20 µm.
    """

    length: float = 1200.0
    height: float = 1000.0
    sheet: float = 1.0  # thickness
    radius_x: float = 9000.0
    radius_z: float = 1900.0
    flange: float = 14.0  # depth of the edge turned inwards
    hem: float = 11.0  # width of the lip turned back behind the sheet
    belt: float = 575.0  # z of the window's lower frame
    window_frame: float = 52.0  # width of the frame around the window
    crease: float = 0.16  # change of slope along the shoulder line
    recess: float = 16.0  # depth behind the handle
    rebate: float = 0.0  # width of the flange that a window is glued to, inwards from its opening; none where 0
    seat: float = 12.0  # depth of that flange's outer face


@dataclass(frozen=True)
class Pane(CarDoor):
    """The window pane that belongs to the door of the same parameters; lengths in mm."""

    gap: float = 16.0  # all round, between the opening's edge and the pane's
    flush: float = 0.0  # the pane's outer surface above (+) or below (−) the sheet's
    glass: float = 4.0


def build(door: CarDoor = CarDoor()) -> trimesh.Trimesh:
    """One closed mesh of the sheet: a tray cut hollow, with a lip left along its edges."""
    return to_mesh(solid(door))


def solid(door: CarDoor) -> Manifold:
    """The door with its window cut out, drilled, and with a handle."""
    drills = union(extrude(circle(size / 2, (x, z)), -400.0, 100.0, "y") for x, z, size in holes(door))
    body = tray(door, door_outline(door) - window_outline(door)) - drills + _handle(door)
    if not door.rebate:
        return body
    opening = window_outline(door)
    ring = opening.offset(door.sheet / 2) - opening.offset(-door.rebate, circular_segments=96)
    return body + _layer(door, ring, door.seat, door.seat + door.sheet)


def tray(door: CarDoor, outline: CrossSection, margin: float = 5.0) -> Manifold:
    """The sheet within an outline, its edges turned inwards and back behind it.

    Args:
        margin: how far the outline may reach beyond the door's length and height, mm.
    """
    inside = outline.offset(-door.sheet, circular_segments=96)
    behind = outline.offset(-door.hem, circular_segments=96)
    floor = door.flange - door.sheet
    hollow = [
        _layer(door, inside, door.sheet, floor, margin),
        _layer(door, behind, floor - 1.0, door.flange + 1.0, margin),
    ]
    return _layer(door, outline, 0.0, door.flange, margin) - union(hollow)


def build_pane(pane: Pane = Pane()) -> trimesh.Trimesh:
    """One closed mesh of the window pane in the door's part frame."""
    outline = window_outline(pane).offset(-pane.gap, circular_segments=96)
    return to_mesh(_layer(pane, outline, -pane.flush, pane.glass - pane.flush))


def outer_surface(door: CarDoor, x: Array, z: Array) -> Array:
    """y of the outer surface at x and z, mm, part frame."""
    lean = (z - 0.4 * door.height) ** 2 / door.radius_z + (x - 0.5 * door.length) ** 2 / door.radius_x
    shoulder = np.hypot(z - _SHOULDER * door.height, 30.0)
    sill = np.hypot(z - _SILL * door.height, 40.0)
    ridges = door.crease / 2 * (sill - shoulder)
    centre = HANDLE * (door.length, door.height)
    u2 = ((x - centre[0]) / _RECESS[0]) ** 2 + ((z - centre[1]) / _RECESS[1]) ** 2
    return ridges - lean / 2 - door.recess * np.clip(1 - u2, 0, None) ** 3


def door_outline(door: CarDoor) -> CrossSection:
    """The door in the x-z plane: sill, rear edge, roof, pillar and front edge, corners rounded."""
    rear = PchipInterpolator([0.0, 0.10, 0.22, 0.42, 0.62, 0.955], [0.93, 0.952, 0.982, 1.0, 0.985, 0.90])
    roof = PchipInterpolator([0.43, 0.66, 0.90], [0.945, 1.0, 0.955])
    front = PchipInterpolator([0.0, 0.2, 0.40, 0.60], [0.03, 0.004, 0.0, 0.03])
    edge = np.linspace(0, 1, 41)
    corners = [(float(rear(z)), z) for z in 0.955 * edge]
    corners += [(x, float(roof(x))) for x in 0.90 - 0.47 * edge[1:]]
    corners += [(float(front(z)), z) for z in 0.60 * edge[::-1]]
    return rounded(polygon(np.array(corners) * (door.length, door.height)), outer=40.0, inner=60.0)


def window_outline(door: CarDoor) -> CrossSection:
    """The window's opening in the x-z plane."""
    above = polygon([(0, door.belt), (door.length, door.belt), (door.length, 2e3), (0, 2e3)])
    # Round offsets would leave the frame of uneven width at the pillar's foot; sharp ones keep it parallel.
    upper = door_outline(door) ^ above.translate((0.0, -door.window_frame / 2))
    return rounded(upper.offset(-door.window_frame, manifold3d.JoinType.Miter), outer=22.0)


def holes(door: CarDoor) -> list[tuple[float, float, float]]:
    """x, z and diameter in mm of the drilled holes: lock, mirror foot and clips of the sill trim."""
    size = np.array([door.length, door.height])
    lock = (*(HANDLE * size + [0.0, -62.0]), 20.0)
    mirror = [(0.075, 0.535, 8.0), (0.115, 0.535, 8.0), (0.095, 0.565, 8.0)]
    clips = [(x, 0.085, 6.0) for x in np.linspace(0.12, 0.88, 6)]
    return [lock, *((x * door.length, z * door.height, d) for x, z, d in mirror + clips)]


def _layer(door: CarDoor, outline: CrossSection, upper: float, lower: float, margin: float = 5.0) -> Manifold:
    """The part of the outline between two depths behind the outer surface."""
    x, z = np.meshgrid(*_lines(door, margin), indexing="ij")
    y = outer_surface(door, x, z)
    # Depth is meant at right angles to the surface; along y it is longer by the slope.
    along, up = np.gradient(y, x[:, 0], z[0])
    stretch = np.sqrt(1 + along**2 + up**2)
    # z before x: about +y the frame turns from z to x.
    levels = [np.stack([x, y - depth * stretch, z], axis=-1).transpose(1, 0, 2) for depth in (upper, lower)]
    return slab(*levels) ^ extrude(outline, -600.0, 200.0, "y")


def _lines(door: CarDoor, margin: float) -> tuple[Array, Array]:
    """Grid lines in x and z: as close as the surface is curved."""
    x, z = HANDLE * (door.length, door.height)
    across = _axis_lines((-margin, door.length + margin), x, _RECESS[0], wide=15.0, fine=3.0)
    return across, _axis_lines((-margin, door.height + margin), z, _RECESS[1], wide=2.6, fine=1.5)


def _axis_lines(ends: tuple[float, float], centre: float, half: float, wide: float, fine: float) -> Array:
    """Positions in mm between two ends: `fine` apart within `half` of the centre, else `wide`."""
    low, high = centre - half, centre + half
    parts = [(ends[0], low, wide), (low, high, fine), (high, ends[1], wide)]
    lines = [np.linspace(start, stop, int((stop - start) / step) + 2) for start, stop, step in parts]
    return np.unique(np.concatenate(lines))


def _handle(door: CarDoor) -> Manifold:
    """A grip across the recess, its ends sunk into the sheet."""
    middle, z = HANDLE * (door.length, door.height)
    knob = Manifold.sphere(1.0, 96).scale((16.0, 7.0, 13.0))
    ends = []
    for x in (middle - 96.0, middle + 96.0):
        y = float(outer_surface(door, np.array(x), np.array(z)))
        ends.append(knob.translate((x, y, z)))
    return Manifold.batch_hull(ends)
