"""A car door with its pane as a robot sees them: scans with known truth, a body warped by welding, stations.

Lengths in mm; scans are in their scanner frames, poses in the robot's base frame.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from manifold3d import CrossSection
from numpy.typing import NDArray

from data_synth.scanner import Scanner, scan
from data_synth.shapes.car_door import CarDoor, Pane, door_outline, outer_surface, window_outline
from stitch import frames

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


def looking_at(target: Array, towards: Array, up: Array, distance: float) -> Array:
    """T_part_scanner (4, 4): scanner at `distance` from the target against `towards` (3,), its y along `up`."""
    z = towards / np.linalg.norm(towards)
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    return frames.make(np.column_stack([x, np.cross(z, x), z]), target - distance * z)


def scan_outside(
    mesh: trimesh.Trimesh, T_base_part: Array, noise: float, seed: int, views: tuple[int, int] = (3, 2),
    rays: int = 150, distance: float = 800.0,
) -> tuple[list[Array], Array]:  # fmt: skip
    """Scans (N, 3) each and T_base_scanner (V, 4, 4) from a grid of views along x and z over the outer side."""
    rng = np.random.default_rng(seed)
    low, high = mesh.bounds
    span = (high - low)[[0, 2]] / views
    angle = 2 * np.degrees(np.arctan(span.max() * 0.6 / distance))
    scanner = Scanner("area", rays, rays, angle, angle, distance, 600.0, noise, mixed_pixels=0.0)
    clouds, poses = [], []
    for i in range(views[0]):
        for j in range(views[1]):
            middle = np.array([low[0] + (i + 0.5) * span[0], 0.0, low[2] + (j + 0.5) * span[1]])
            lean = np.array([*rng.uniform(-0.25, 0.25, 1), -1.0, *rng.uniform(-0.25, 0.25, 1)])
            T = looking_at(middle, lean, np.array([0.0, 0.0, 1.0]), distance)
            clouds.append(scan(mesh, T, scanner, NO_FIELD, rng).points)
            poses.append(T_base_part @ T)
    return clouds, np.array(poses)


def stations(pane: Pane) -> tuple[Array, Array, Array]:
    """Eight places of the seam: middle of the nominal gap (8, 3), across from pane to body, outwards; part frame."""
    return along_loop(pane, window_outline(pane).offset(-pane.gap / 2, circular_segments=96), 8)


def along_loop(door: CarDoor, outline: CrossSection, count: int) -> tuple[Array, Array, Array]:
    """Places on the outer surface along an outline (count, 3), out of the loop and out of the surface; part frame."""
    loop = np.asarray(max(outline.to_polygons(), key=len), float)
    steps = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)
    at = np.concatenate([[0], np.cumsum(steps)])
    closed = np.vstack([loop, loop[:1]])
    # Straight runs only: the corners' stations would mix two edges.
    places = _straight(closed, at, count)
    middle, across, outwards = [], [], []
    centre = loop.mean(axis=0)
    for s in places:
        p, ahead = (np.array([np.interp(t, at, closed[:, k]) for k in (0, 1)]) for t in (s, s + 1.0))
        along = (ahead - p) / np.linalg.norm(ahead - p)
        out = np.array([along[1], -along[0]])
        out *= np.sign(out @ (p - centre))
        n = _normal(door, p)
        t = np.array([out[0], 0.0, out[1]])
        t -= (t @ n) * n
        middle.append([p[0], float(outer_surface(door, *np.asarray(p))), p[1]])
        across.append(t / np.linalg.norm(t))
        outwards.append(n)
    return np.array(middle), np.array(across), np.array(outwards)


def _straight(closed: Array, at: Array, count: int) -> Array:
    """Arc lengths of places about evenly along the loop, at least 30 mm from sharp bends."""
    grid = np.linspace(0, at[-1], 2000, endpoint=False)
    p = [np.column_stack([np.interp((grid + d) % at[-1], at, closed[:, k]) for k in (0, 1)]) for d in (-30, 0, 30)]
    a, b = p[1] - p[0], p[2] - p[1]
    bend = np.abs(np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1)))
    good = grid[bend < 0.12]
    return good[np.linspace(0, len(good) - 1, count, endpoint=False).astype(int) + len(good) // (2 * count)]


def _normal(door: CarDoor, p: Array) -> Array:
    h = 0.5
    dx = (outer_surface(door, p[0] + h, p[1]) - outer_surface(door, p[0] - h, p[1])) / (2 * h)
    dz = (outer_surface(door, p[0], p[1] + h) - outer_surface(door, p[0], p[1] - h)) / (2 * h)
    n = np.array([-float(dx), 1.0, -float(dz)])
    return n / np.linalg.norm(n)


def scan_edges(
    mesh: trimesh.Trimesh, T_base_part: Array, door: CarDoor, kind: str, noise: float, seed: int, count: int = 10,
    rays: int = 110,
) -> tuple[list[Array], Array]:  # fmt: skip
    """Close scans along the edges of a "door" (outline and window) or a "pane", leaned so that flanks are seen."""
    rng = np.random.default_rng(seed)
    if kind == "pane":
        loops = [(window_outline(door).offset(-16.0, circular_segments=96), 1.0)]
    else:
        loops = [(door_outline(door), 1.0), (window_outline(door), -1.0)]
    scanner = Scanner("area", rays, rays, 10.0, 10.0, 400.0, 200.0, noise)
    clouds, poses = [], []
    for outline, facing in loops:
        for m, t, n in zip(*along_loop(door, outline, count), strict=True):
            T = looking_at(m, -np.cos(0.75) * n - np.sin(0.75) * facing * t, np.cross(n, t), 400.0)
            clouds.append(scan(mesh, T, scanner, NO_FIELD, rng).points)
            poses.append(T_base_part @ T)
    return clouds, np.array(poses)


def scan_seam(
    meshes: list[trimesh.Trimesh], T_base_part: Array, middle: Array, across: Array, outwards: Array, noise: float,
    seed: int, tilt: float = 35.0, rays: int = 130,
) -> tuple[list[Array], Array]:  # fmt: skip
    """Two scans at each station, leaned to either side so that both edges' flanks are seen."""
    rng = np.random.default_rng(seed)
    both = trimesh.util.concatenate(meshes)
    scanner = Scanner("area", rays, rays, 9.0, 9.0, 400.0, 200.0, noise)
    clouds, poses = [], []
    for m, t, n in zip(middle, across, outwards, strict=True):
        for side in (1, -1):
            lean = np.radians(tilt) * side
            T = looking_at(m, -np.cos(lean) * n + np.sin(lean) * t, np.cross(n, t), 400.0)
            clouds.append(scan(both, T, scanner, NO_FIELD, rng).points)
            poses.append(T_base_part @ T)
    return clouds, np.array(poses)


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
