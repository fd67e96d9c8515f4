"""A wavy panel scanned in rows by a scanner on the flange: as many views and points as one likes, at constant overlap.

The surface is a formula, so that rays meet it by Newton's method and every scanned point's distance from the truth is
known, at a million points in seconds.
"""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
# Field of view, distance and step between views (mm): neighbours share half of what they see.
_HALF_ANGLE, _STANDOFF, _STEP = 16.7, 500.0, 150.0
NOISE, REPEATABILITY, TURN = 0.015, 0.02, 2e-5
_NEWTON = 12


def height(x: Array, y: Array) -> Array:
    """z of the panel, mm."""
    waves = 14 * np.sin(x / 47 + 0.3) * np.cos(y / 61) + 9 * np.sin((x + 0.7 * y) / 83)
    return np.asarray(waves + 5 * np.cos((y - 0.4 * x) / 37))


def slopes(x: Array, y: Array) -> tuple[Array, Array]:
    """Its derivatives by x and y."""
    a, b, c = x / 47 + 0.3, (x + 0.7 * y) / 83, (y - 0.4 * x) / 37
    by_x = 14 / 47 * np.cos(a) * np.cos(y / 61) + 9 / 83 * np.cos(b) + 5 * 0.4 / 37 * np.sin(c)
    by_y = -14 / 61 * np.sin(a) * np.sin(y / 61) + 9 * 0.7 / 83 * np.cos(b) - 5 / 37 * np.sin(c)
    return by_x, by_y


def distance(points: Array) -> Array:
    """(N,) of points from the panel, along its normal; exact to second order."""
    x, y, z = points.T
    by_x, by_y = slopes(x, y)
    return np.asarray((z - height(x, y)) / np.sqrt(1 + by_x**2 + by_y**2))


def write_panel(folder: Path, views: int, points: int, seed: int = 0) -> Path:
    """A session of `views` scans of some `points` points each, and its hand-eye beside it as NAME.mount.json."""
    (folder / "clouds").mkdir(parents=True)
    rng = np.random.default_rng(seed)
    T_flange_scanner = _rigid(Rotation.from_euler("xyz", [4, -7, 31], degrees=True), [62, -18, 143])
    start = T_flange_scanner @ _rigid(Rotation.from_rotvec(rng.normal(0, 2e-3, 3)), rng.normal(0, 1.5, 3))
    rows = max(1, round((views / 2) ** 0.5))
    columns = -(-views // rows)
    table = ["view,cloud,x,y,z,qx,qy,qz,qw"]
    for v in range(views):
        x, y = _STEP * (v % columns), _STEP * (v // columns)
        T_base_scanner = _looking_at(x, y, rng)
        _write_ply(folder / "clouds" / f"v{v:04d}.ply", _scan(T_base_scanner, round(points**0.5), rng))
        scatter = _rigid(Rotation.from_rotvec(rng.normal(0, TURN, 3)), rng.normal(0, REPEATABILITY, 3))
        T = T_base_scanner @ np.linalg.inv(T_flange_scanner) @ scatter
        pose = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
        table.append(f"v{v:04d},clouds/v{v:04d}.ply," + ",".join(f"{c:.9f}" for c in pose))
    (folder / "views.csv").write_text("\n".join(table) + "\n")
    head = f'format = "stitch-session/1"\nname = "{folder.name}"\nlength_unit = "mm"\nmount = "eye_in_hand"\n'
    (folder / "session.toml").write_text(f"{head}\n[scanner]\nnoise = {NOISE}\npose = {start.tolist()}\n")
    folder.with_suffix(".mount.json").write_text(json.dumps(T_flange_scanner.tolist()))
    return folder


def _looking_at(x: float, y: float, rng: np.random.Generator) -> Array:
    at = np.array([x, y, float(height(np.array(x), np.array(y)))]) + rng.normal(0, 5, 3)
    tilts = rng.uniform(-22, 22, 2)
    R = Rotation.from_euler("xyz", [180 + tilts[0], tilts[1], rng.uniform(-180, 180)], degrees=True)
    return _rigid(R, at - _STANDOFF * R.apply([0, 0, 1]))


def _scan(T_base_scanner: Array, side: int, rng: np.random.Generator) -> Array:
    """Points (N, 3) where the rays of a square grid meet the panel first enough, scanner frame, with noise."""
    half = np.tan(np.radians(_HALF_ANGLE))
    u, v = (g.ravel() for g in np.meshgrid(*[np.linspace(-half, half, side)] * 2))
    rays = np.column_stack([u, v, np.ones_like(u)])
    ahead, origin = rays @ T_base_scanner[:3, :3].T, T_base_scanner[:3, 3]
    depth = np.full(len(rays), _STANDOFF)
    for _ in range(_NEWTON):
        x, y, z = (origin + depth[:, None] * ahead).T
        by_x, by_y = slopes(x, y)
        above = z - height(x, y)
        depth -= above / (ahead[:, 2] - by_x * ahead[:, 0] - by_y * ahead[:, 1])
    points = rays[np.abs(above) < 1e-6] * depth[np.abs(above) < 1e-6, None]
    far = np.linalg.norm(points, axis=1, keepdims=True)
    return np.asarray(points * (1 + rng.normal(0, NOISE, (len(points), 1)) / far))


def _rigid(rotation: Rotation, translation: Array | list[float]) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), translation
    return T


def _write_ply(file: Path, points: Array) -> None:
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{names}end_header\n"
    file.write_bytes(head.encode() + points.astype("<f4").tobytes())
