"""Where a scanner must stand to see a car door, its pane or the seam between them: T_part_scanner, lengths in mm."""

import numpy as np
from manifold3d import CrossSection
from numpy.typing import NDArray

from data_synth.shapes.car_door import CarDoor, Pane, door_outline, outer_surface, window_outline
from stitch.numerics import frames

Array = NDArray[np.float64]


def looking_at(target: Array, towards: Array, up: Array, distance: float) -> Array:
    """T_part_scanner (4, 4): scanner at `distance` from the target against `towards` (3,), its y along `up`."""
    z = towards / np.linalg.norm(towards)
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    return frames.make(np.column_stack([x, np.cross(z, x), z]), target - distance * z)


def over(bounds: Array, grid: tuple[int, int], distance: float, rng: np.random.Generator) -> Array:
    """(V, 4, 4): a grid of views along x and z over the outer side of what lies in bounds (2, 3), leaned a little."""
    low, high = bounds
    span = (high - low)[[0, 2]] / grid
    poses = []
    for i in range(grid[0]):
        for j in range(grid[1]):
            middle = np.array([low[0] + (i + 0.5) * span[0], 0.0, low[2] + (j + 0.5) * span[1]])
            lean = np.array([*rng.uniform(-0.25, 0.25, 1), -1.0, *rng.uniform(-0.25, 0.25, 1)])
            poses.append(looking_at(middle, lean, np.array([0.0, 0.0, 1.0]), distance))
    return np.array(poses)


def along_edges(door: CarDoor, kind: str, count: int, distance: float) -> Array:
    """(V, 4, 4): along the edges of a "door" (outline and window) or a "pane", leaned so that flanks are seen."""
    if kind == "pane":
        loops = [(window_outline(door).offset(-16.0, circular_segments=96), 1.0)]
    else:
        loops = [(door_outline(door), 1.0), (window_outline(door), -1.0)]
    poses = [
        looking_at(m, -np.cos(0.75) * n - np.sin(0.75) * facing * t, np.cross(n, t), distance)
        for outline, facing in loops
        for m, t, n in zip(*along_loop(door, outline, count), strict=True)
    ]
    return np.array(poses)


def across_seam(middle: Array, across: Array, outwards: Array, tilt: float, distance: float) -> Array:
    """(2 V, 4, 4): two views of each station, leaned by `tilt` (deg) to either side so that both flanks are seen."""
    leans = np.radians(tilt) * np.array([1.0, -1.0])
    poses = [
        looking_at(m, -np.cos(lean) * n + np.sin(lean) * t, np.cross(n, t), distance)
        for m, t, n in zip(middle, across, outwards, strict=True)
        for lean in leans
    ]
    return np.array(poses)


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
