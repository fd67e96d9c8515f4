"""A car door with its pane as a robot sees them: scans with known truth, a body warped by welding, stations.

Lengths in mm; scans are in their scanner frames, poses in the robot's base frame.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from data_synth.cells.window_views import across_seam, along_edges, over
from data_synth.scanner import Scanner
from data_synth.scanning import scan
from data_synth.shapes.car_door import CarDoor
from stitch.numerics import frames

Array = NDArray[np.float64]

NO_FIELD = np.zeros((3, 3))


@dataclass(frozen=True)
class Weld:
    """A smooth dent or bulge that welding leaves: Gaussian, along y (across the sheet)."""

    x: float = 320.0
    z: float = 150.0
    size: float = 3.0  # mm, positive inwards
    reach: float = 130.0  # 1-sigma of its extent


def warp(mesh: trimesh.Trimesh, weld: Weld) -> trimesh.Trimesh:
    """The mesh with the dent."""
    moved = mesh.copy()
    moved.vertices[:, 1] -= dent(weld, moved.vertices[:, 0], moved.vertices[:, 2])
    return moved


def dent(weld: Weld, x: Array, z: Array) -> Array:
    """Depth at x and z, mm."""
    return np.asarray(weld.size * np.exp(-((x - weld.x) ** 2 + (z - weld.z) ** 2) / (2 * weld.reach**2)))


def scan_outside(
    mesh: trimesh.Trimesh,
    T_base_part: Array,
    noise: float,
    seed: int,
    views: tuple[int, int] = (3, 2),
    rays: int = 150,
    distance: float = 800.0,
) -> tuple[list[Array], Array]:
    """Scans (N, 3) each and T_base_scanner (V, 4, 4) from a grid of views along x and z over the outer side."""
    rng = np.random.default_rng(seed)
    span = np.ptp(mesh.bounds, axis=0)[[0, 2]] / views
    angle = 2 * np.degrees(np.arctan(span.max() * 0.6 / distance))
    scanner = area_scanner(rays, angle, distance, depth=600.0, noise=noise)
    return _scanned(mesh, over(mesh.bounds, views, distance, rng), T_base_part, scanner, rng)


def scan_edges(
    mesh: trimesh.Trimesh,
    T_base_part: Array,
    door: CarDoor,
    kind: str,
    noise: float,
    seed: int,
    count: int = 10,
    rays: int = 110,
) -> tuple[list[Array], Array]:
    """Close scans along the edges of a "door" (outline and window) or a "pane", leaned so that flanks are seen."""
    scanner = area_scanner(rays, 10.0, 400.0, depth=200.0, noise=noise)
    rng = np.random.default_rng(seed)
    return _scanned(mesh, along_edges(door, kind, count, 400.0), T_base_part, scanner, rng)


def scan_seam(
    meshes: list[trimesh.Trimesh],
    T_base_part: Array,
    places: tuple[Array, Array, Array],
    noise: float,
    seed: int,
    rays: int = 130,
) -> tuple[list[Array], Array]:
    """Two scans at each station, leaned to either side so that both edges' flanks are seen.

    Args:
        places: middle of the gap, across it and outwards, (V, 3) each, part frame.
    """
    scanner = area_scanner(rays, 9.0, 400.0, depth=200.0, noise=noise)
    views, both = across_seam(*places, 35.0, 400.0), trimesh.util.concatenate(meshes)
    return _scanned(both, views, T_base_part, scanner, np.random.default_rng(seed))


def area_scanner(rays: int, field_of_view: float, standoff: float, depth: float, noise: float) -> Scanner:
    """A square area scanner of rays × rays points; degrees and mm."""
    angle = field_of_view
    return Scanner("area", rays, rays, angle, angle, standoff=standoff, depth_of_field=depth, noise=noise)


def _scanned(
    mesh: trimesh.Trimesh, T_part_scanner: Array, T_base_part: Array, scanner: Scanner, rng: np.random.Generator
) -> tuple[list[Array], Array]:
    clouds = [scan(mesh, T, scanner, NO_FIELD, rng).points for T in T_part_scanner]
    return clouds, T_base_part @ T_part_scanner


def true_seam(pane: trimesh.Trimesh, door: trimesh.Trimesh, T_part_station: Array) -> tuple[float, float]:
    """Flush and gap of the meshes, mm: cut at the station, take the outer corner on each side."""
    corners = []
    for mesh, side in ((pane, -1.0), (door, 1.0)):
        cut = mesh.section(plane_origin=T_part_station[:3, 3], plane_normal=T_part_station[:3, 1])
        local = frames.transform(frames.inverse(T_part_station), np.asarray(cut.vertices))
        own = local[(side * local[:, 0] > 0) & (np.abs(local[:, 0]) < 30)]
        # The corner is the furthest vertex up and towards the gap.
        corners.append(own[np.argmax(own[:, 2] - side * own[:, 0])])
    return float(corners[0][2] - corners[1][2]), float(corners[1][0] - corners[0][0])


def true_bond_gap(pane: trimesh.Trimesh, door: trimesh.Trimesh, T_part_station: Array, across: float) -> float:
    """From the pane's inner face down to the flange behind it, at a place across the seam (station frame), mm."""
    start = frames.transform(T_part_station, np.array([[across, 0.0, 0.0]]))
    depths = []
    for mesh in (pane, door):
        down = mesh.ray.intersects_location(start + 50 * T_part_station[:3, 2], -T_part_station[None, :3, 2])[0]
        depths.append(frames.transform(frames.inverse(T_part_station), down)[:, 2])
    return float(depths[0].min() - depths[1].max())
