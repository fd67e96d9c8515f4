"""Large sessions: seconds, memory and distance from the truth over points a view and over views.

A wavy panel is scanned in rows at constant overlap. The surface is a formula, so that every scanned point's distance
from the truth is known. Panels (30 MB for a view of a million points) and runs stay in the folder of the setting
`folder`.
"""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from bench.harness import Row, Table, grouped, markdown, stitch_process
from stitch.numerics import frames
from stitch.numerics.frames import Array

# Points of a view at which views grow, views at which points grow, and the largest of both.
AT_VIEWS, AT_POINTS, LARGEST = 18, 20_000, (200, 1_000_000)
VIEWS, POINTS = (10, 30, 100, 300), (10_000, 100_000, 1_000_000, 10_000_000)
# Field of view, distance and step between views (mm): neighbours share half of what they see.
_HALF_ANGLE, _STANDOFF, _STEP = 16.7, 500.0, 150.0
NOISE, REPEATABILITY, TURN = 0.015, 0.02, 2e-5
_NEWTON = 12


def large_jobs(seeds: range, folder: str, most: float) -> Iterator[Row]:
    """Panels of more points and of more views, up to `most` points in all."""
    of_points, of_views = [(AT_VIEWS, p) for p in POINTS], [(v, AT_POINTS) for v in VIEWS]
    for grows, cases in (("points", of_points), ("views", of_views), ("both", [LARGEST])):
        for views, points in cases:
            if views * points <= most:
                yield {"grows": grows, "views": views, "points": points, "folder": folder}


def large_trial(job: Row) -> Row:
    """One run of the whole command, page included, recording not."""
    session = Path(job["folder"]) / f"panel-{job['views']}-{job['points']}"
    if not session.is_dir():
        write_panel(session, job["views"], job["points"])
    run = session.with_name(f"run-{session.name}")
    cost = stitch_process("run", session, "-o", run, "--no-recording", "--force", "--memory", "3GB")
    points = points_of(run / "stitched.ply")
    off = np.abs(distance(points[:: max(1, len(points) // 1_000_000)]))
    result = json.loads((run / "result.json").read_text())
    stages = {stage["name"]: stage["seconds"] for stage in result["stages"]}
    quality = {"median": float(np.median(off)), "most": float(np.quantile(off, 0.95))}
    return {"all": sum(view["points"] for view in result["views"]), "stages": stages, **cost, **quality}


def large_summary(rows: list[Row]) -> list[str]:
    """The rows, with the exponent of the processor's seconds over points or views."""
    head = "views | points a view | million points | s | CPU s | s per million | memory, GB | median µm | 95 % µm"
    lines = []
    for grows, group in grouped(rows, "grows").items():
        cells = []
        for r in group:
            size = [r["views"], f"{r['points']:,}", f"{r['all'] / 1e6:.2f}"]
            cost = [
                f"{r['seconds']:.1f}",
                f"{r['cpu']:.1f}",
                f"{1e6 * r['seconds'] / r['all']:.2f}",
                f"{r['memory']:.2f}",
            ]
            cells.append([*size, *cost, f"{1e3 * r['median']:.1f}", f"{1e3 * r['most']:.1f}"])
        lines += [f"**More {'of both' if grows == 'both' else grows}**", "", *markdown(head, cells), ""]
        if grows != "both":
            steps = [
                f"{np.log(b['cpu'] / a['cpu']) / np.log(b[grows] / a[grows]):.2f}" for a, b in itertools.pairwise(group)
            ]
            power = f"CPU seconds go with the number of {grows} to the power of {', '.join(steps)}, from row to row."
            lines += [power, ""]
    return lines


LARGE = Table(
    *(large_jobs, large_trial, large_summary, range(1)), page="large-sessions", block="large", one_core=False,
    settings={"folder": "runs/large", "most": 2e8},
)  # fmt: skip


def height(x: Array, y: Array) -> Array:
    """z of the panel, mm."""
    waves = 14 * np.sin(x / 47 + 0.3) * np.cos(y / 61) + 9 * np.sin((x + 0.7 * y) / 83)
    return waves + 5 * np.cos((y - 0.4 * x) / 37)


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
    return (z - height(x, y)) / np.sqrt(1 + by_x**2 + by_y**2)


def write_panel(folder: Path, views: int, points: int, seed: int = 0) -> Path:
    """A session of `views` scans of some `points` points each, and its hand-eye beside it as NAME.mount.json."""
    (folder / "clouds").mkdir(parents=True)
    rng = np.random.default_rng(seed)
    T_flange_scanner = frames.make(Rotation.from_euler("xyz", [4, -7, 31], degrees=True).as_matrix(), [62, -18, 143])
    start = T_flange_scanner @ frames.make(
        Rotation.from_rotvec(rng.normal(0, 2e-3, 3)).as_matrix(), rng.normal(0, 1.5, 3)
    )
    rows = max(1, round((views / 2) ** 0.5))
    columns = -(-views // rows)
    table = ["view,cloud,x,y,z,qx,qy,qz,qw"]
    for v in range(views):
        x, y = _STEP * (v % columns), _STEP * (v // columns)
        T_base_scanner = _looking_at(x, y, rng)
        _write_ply(folder / "clouds" / f"v{v:04d}.ply", _scan(T_base_scanner, round(points**0.5), rng))
        scatter = frames.make(Rotation.from_rotvec(rng.normal(0, TURN, 3)).as_matrix(), rng.normal(0, REPEATABILITY, 3))
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
    return frames.make(R.as_matrix(), at - _STANDOFF * R.apply([0, 0, 1]))


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
    return points * (1 + rng.normal(0, NOISE, (len(points), 1)) / far)


def _write_ply(file: Path, points: Array) -> None:
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{names}end_header\n"
    file.write_bytes(head.encode() + points.astype("<f4").tobytes())


def points_of(file: Path) -> Array:
    return np.asarray(trimesh.load(file).vertices, float)
