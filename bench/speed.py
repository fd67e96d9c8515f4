"""Speed and memory: large sessions, a diagnosis, and this project beside its peers.

LARGE: seconds, memory and distance from the truth over points a view and over views, of a wavy panel that is scanned in
rows at constant overlap. The surface is a formula, so that every scanned point's distance from the truth is known.
Panels (30 MB for a view of a million points) and runs stay in the folder of the setting `folder`.

DIAGNOSE: whole commands on a blade of 18 views, reading the session and writing the page included; then the
correspondences of that session streamed through the sums of all effects of points, where an N×K matrix would not fit.

PEERS: this project and its peers on the same scans and start poses, alternating; the peers with their clouds thinned to
several grids, as their users tune them. Whole commands, from files to a merged cloud; stitch also finds the hand-eye,
tests the views and writes its page, or as a second row, all that and the recording. The setting `python` belongs to an
environment with numpy, plyfile, open3d and small_gicp.
"""

import itertools
import json
import os
import resource
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from bench.harness import PICTURES, ROOT, Row, Table, grouped, markdown, stitch_process
from data_synth.fixtures.part_distance import off_surface
from data_synth.fixtures.quiet_scenes import mesh_of
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from data_synth.write import write_session
from stitch.effects.contract import EFFECTS, missing_need
from stitch.model.forward import corrected_capture, moves_points
from stitch.model.model import term_of
from stitch.numerics import frames
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array
from stitch.observations.surfaces.effect_columns import view_responses
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.output.stored_run import load_run
from stitch.session.capture import build_capture
from stitch.session.reading.session_folder import load_session
from stitch.system.threads import library_threads_off

# Points of a view at which views grow, views at which points grow, and the largest of both.
AT_VIEWS, AT_POINTS, LARGEST = 18, 20_000, (200, 1_000_000)
VIEWS, POINTS = (10, 30, 100, 300), (10_000, 100_000, 1_000_000, 10_000_000)
CELLS = (("blade", 11), ("blade", 12), ("blade", 15), ("blade-table", 16), ("car-door", 17))
VOXELS = (0.0, 1.0, 1.5, 2.0)  # mm
PEER_NAMES = ("open3d", "small_gicp")
OURS = ("run --no-recording", "run")
# Field of view, distance and step between views (mm): neighbours share half of what they see.
_HALF_ANGLE, _STANDOFF, _STEP = 16.7, 500.0, 150.0
NOISE, REPEATABILITY, TURN = 0.015, 0.02, 2e-5
_NEWTON = 12
# Points of a view of the blade scene with 280 × 280 rays.
_USUAL_RAYS, _USUAL_POINTS = 280, 15_840


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


def diagnose_jobs(seeds: range, points: int, correspondences: int) -> Iterator[Row]:
    """One session of about so many points a view."""
    yield {"points": points, "correspondences": correspondences}


def diagnose_trial(job: Row) -> Row:
    """Seconds and memory of every command, and of the sums over many correspondences."""
    with tempfile.TemporaryDirectory() as folder:
        session, run = Path(folder) / "blade", Path(folder) / "run"
        scene = load_scene("blade")
        rays = round(_USUAL_RAYS * (job["points"] / _USUAL_POINTS) ** 0.5)
        scene = replace(scene, scanner=replace(scene.scanner, columns=rays, rows=rays))
        measured = simulate(scene, {"joint_compliance": 2.0}, seed=3)
        write_session(session, measured, "blade")
        commands = {"run": ["run", session, "-o", run], "diagnose": ["diagnose", run], "compare": ["compare", run]}
        costs = {name: stitch_process(*words) for name, words in commands.items()}
        mean = float(np.mean([len(cloud.points) for cloud in measured.clouds]))
        return {"views": len(measured.clouds), "mean": mean, "costs": costs, "sums": _sums(run, job["correspondences"])}


def _sums(run: Path, correspondences: int) -> Row:
    """Effects of points over so many correspondences, in this process."""
    state = load_run(run)
    with library_threads_off():
        capture = corrected_capture(state.measurement, state.model)
        poses = capture.poses(state.model.T_mount)
        few = collect_overlaps(capture, poses, state.gate, [sample_points(scan, 1000) for scan in capture.scans])
        per_view = round(1000 * correspondences / few.gram.count.sum())
        many = collect_overlaps(capture, poses, state.gate, [sample_points(scan, per_view) for scan in capture.scans])
    before = _peak()
    library = [term_of(state.measurement, e) for e in EFFECTS.values() if not missing_need(state.measurement, e)]
    terms = [term for term in library if moves_points([term])]
    begun = time.perf_counter()
    views = UnconstrainedPoses(poses, np.zeros((len(poses), 6)), many)
    responses = view_responses(state.measurement, state.model, terms, views)
    columns = sum(r.columns.shape[1] for r in responses)
    sizes = {"count": sum(len(m.residual) for m in many.matches), "columns": columns}
    return {"seconds": time.perf_counter() - begun, "before": before, "peak": _peak(), **sizes}


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def diagnose_summary(rows: list[Row]) -> list[str]:
    """Commands, and the sums beside the matrix that they spare."""
    [row] = rows
    costs = ([f"stitch {name}", f"{c['seconds']:.1f}", f"{c['memory']:.2f}"] for name, c in row["costs"].items())
    s = row["sums"]
    return [
        f"{row['views']} views of {row['mean']:,.0f} points on the average:",
        "",
        *markdown("command | s | memory, GB", costs),
        "",
        f"{s['count']:,} correspondences × {s['columns']} columns: {s['seconds']:.1f} s, peak {s['peak']:.2f} GB, "
        f"{s['before']:.2f} GB before (a matrix of all would be {s['count'] * s['columns'] * 8e-9:.1f} GB more).",
    ]


DIAGNOSE = Table(
    diagnose_jobs, diagnose_trial, diagnose_summary, range(1), one_core=False,
    settings={"points": 200_000, "correspondences": 10_000_000},
)  # fmt: skip


def peer_jobs(seeds: range, python: str, rounds: int) -> Iterator[Row]:
    """A cell each."""
    yield from ({"scene": scene, "seed": seed, "python": python, "rounds": rounds} for scene, seed in CELLS)


def peer_trial(job: Row) -> Row:
    """Of every program: seconds (the median of rounds in turns), median and 95 % distance from the part (µm)."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        session, start, run = folder / "cell", folder / "start.npy", folder / "run"
        stitch_process("synth", job["scene"], session, "--seed", job["seed"])
        np.save(start, _start_poses(session))
        theirs = [job["python"], str(ROOT / "bench" / "peer_programs.py")]
        commands = {}
        for peer, voxel in itertools.product(PEER_NAMES, VOXELS):
            out = folder / f"{peer} {voxel}.npy"
            commands[f"{peer} {voxel}"] = [*theirs, peer, str(voxel), str(session / "clouds"), str(start), str(out)]
        seconds: dict[str, list[float]] = {name: [] for name in (*OURS, *commands)}
        for _ in range(job["rounds"]):
            for name in OURS:
                flags = ["--no-recording"] if name == OURS[0] else []
                seconds[name].append(stitch_process("run", session, "--force", "-o", run, *flags)["seconds"])
            for name, command in commands.items():
                begun = time.perf_counter()
                subprocess.run(command, check=True, capture_output=True)
                seconds[name].append(time.perf_counter() - begun)
        poses = {name: np.load(folder / f"{name}.npy") for name in commands}
        views = json.loads((run / "result.json").read_text())["views"]
        poses |= dict.fromkeys(OURS, np.array([view["pose"] for view in views]))
        clouds = [points_of(file) for file in sorted((session / "clouds").iterdir())]
        truth = json.loads(session.with_suffix(".truth.json").read_text())
        off = {name: 1e3 * _off_part(job["scene"], clouds, poses[name], truth) for name in seconds}
        programs = {
            name: [float(np.median(times)), *np.quantile(off[name], (0.5, 0.95)).tolist()]
            for name, times in seconds.items()
        }
        return {"programs": programs, "points": sum(map(len, clouds))}


def points_of(file: Path) -> Array:
    return np.asarray(trimesh.load(file).vertices, float)


def _start_poses(session: Path) -> Array:
    """T_reference_scanner (V, 4, 4) of the robot and the hand-eye that the session states."""
    loaded = load_session(session)
    assert loaded.scanner.T_mount is not None
    poses = np.array([view.T_base_flange for view in loaded.views])
    return build_capture(loaded.name, (), poses, loaded.mount).poses(loaded.scanner.T_mount)


def _off_part(scene: str, clouds: list[Array], poses: Array, truth: Row) -> Array:
    """(N,) of all points from the true part (mm), after the rigid motion that no scan can tell."""
    placed = np.concatenate([frames.transform(T, c) for T, c in zip(poses, clouds, strict=True)])
    in_part = frames.transform(part_from_reference(clouds, poses, truth), placed)
    return np.abs(off_surface(mesh_of(scene), in_part)[0])


def part_from_reference(clouds: list[Array], poses: Array, truth: Row) -> Array:
    """T_part_reference (4, 4) of a run: its views brought nearest to where they truly were, then into the part."""
    placed, right = (
        np.concatenate([frames.transform(T, c) for T, c in zip(p, clouds, strict=True)])
        for p in (poses, np.array(truth["poses"]))
    )
    T_reference_run = align_points(placed, right)
    return frames.inverse(np.array(truth["T_reference_part"])) @ T_reference_run


def peer_summary(rows: list[Row]) -> list[str]:
    """Medians over all cells, and each cell by itself; the picture is drawn beside them."""
    programs = {name: np.array([row["programs"][name] for row in rows]) for name in rows[0]["programs"]}
    first, lines = programs[OURS[0]], []
    for name, cells in programs.items():
        ratio = cells[:, 0] / first[:, 0]
        ahead = "" if name in OURS else (cells < first)[:, :2].all(axis=1).sum()
        times = f"{np.median(ratio):.2f} ({ratio.min():.2f} … {ratio.max():.2f})"
        seconds, off, most = (f"{x:.1f}" for x in np.median(cells, axis=0))
        lines.append([name.removesuffix(" 0.0"), seconds, times, off, most, ahead])
    every = [
        [
            f"{r['scene']}, seed {r['seed']}",
            f"{r['points']:,}",
            *(f"{s:.1f}, {d:.1f}" for s, d, _ in r["programs"].values()),
        ]
        for r in rows
    ]
    _draw_peers(programs)
    head = "program | s | times the first (least … most) | median µm off the part | 95 % µm | cells where "
    head += "faster and nearer"
    return [
        f"{len(rows)} cells, {os.cpu_count()} cores; medians over the cells, rounds in turns: {rows[0]['rounds']}. "
        "Beside a peer stands its grid in mm; without one it has all points.",
        "",
        *markdown(head, lines),
        "",
        "Seconds and median µm off the part in each cell:",
        "",
        *markdown(" | ".join(["cell", "points", *(name.removesuffix(" 0.0") for name in programs)]), every),
    ]


def _draw_peers(programs: dict[str, Array]) -> None:
    """Quality against time: a line for each peer over its grids, and this project's whole command."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for name, colour in zip(PEER_NAMES, ("tab:orange", "tab:green"), strict=True):
        seconds, off, _ = np.array([np.median(programs[f"{name} {voxel}"], axis=0) for voxel in VOXELS]).T
        axes.plot(seconds, off, "o-", color=colour, label=f"{name}, alignment alone")
        for voxel, *place in zip(VOXELS, seconds, off, strict=True):
            text = f"{voxel:g} mm" if voxel else "all points"
            axes.annotate(text, place, (5, 5), textcoords="offset points", fontsize=8)
    for name, sign in zip(OURS, ("o", "s"), strict=True):
        seconds, off, _ = np.median(programs[name], axis=0)
        axes.plot(seconds, off, sign, color="tab:blue", label=f"stitch {name}")
    axes.set(xlabel="seconds, from files to a merged cloud", ylabel="median distance from the true part, µm")
    axes.set_xlim(left=0)
    axes.set_yscale("log")
    axes.legend()
    figure.savefig(PICTURES / "peers.png", dpi=110)


PEERS = Table(
    peer_jobs, peer_trial, peer_summary, range(1), page="large-sessions", block="peers", one_core=False,
    settings={"python": "python", "rounds": 1},
)  # fmt: skip
