"""Scan onto CAD and seam on a car door and its pane; and the whole line, whose error budget is the second table.

The line: sphere hand-eye, window and body onto CAD, corrected path, placed window, measured seam. Everything between
simulator and simulator is a command of stitch.
"""

import csv
import json
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from bench.harness import Parts, Row, Table, grouped, markdown
from data_synth.cells import window_scans, window_views
from data_synth.cells.window_line import EXACT, Errors, WindowLine
from data_synth.cells.window_line_job import write_line, write_seam
from data_synth.shapes import car_door
from data_synth.shapes.car_door import CarDoor, Pane
from stitch.cli.main import main as stitch
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.cells.cad import Box, CadSurface, Regions, cad_surface
from stitch.plugins.cells.job_files import POSE_COLUMNS, poses_from_columns, read_columns
from stitch.plugins.cells.placed_scans import JoinedScans, join_scans
from stitch.plugins.cells.scan_to_cad import CadFit, find_cad_start, fit_cad
from stitch.plugins.cells.seam import Limits, Station, measure_seam
from stitch.session.scan import prepare_scan

NOISE = 0.05
WINDOW_FRAME = Box("window frame", np.array([-9.0, -200, 600]), np.array([1300.0, 100, 1100]))
# By name: the part, a welding bulge, which overview and close scans are taken, and what is expected to fit.
EVERYTHING, FRONT = (slice(None), slice(None)), (slice(0, 4), slice(0, 5))
SMALL_WELD, LARGE_WELD = window_scans.Weld(), window_scans.Weld(size=6.0, reach=200.0)
CASES = {
    "pane": ("pane", None, EVERYTHING, None),
    "door": ("door", None, EVERYTHING, None),
    "door, front third of it scanned": ("door", None, FRONT, None),
    "door, welding bulge 3 mm, σ 130 mm": ("door", SMALL_WELD, EVERYTHING, None),
    "door, welding bulge 6 mm, σ 200 mm": ("door", LARGE_WELD, EVERYTHING, None),
    "the same, window frame expected": ("door", LARGE_WELD, EVERYTHING, Regions(expected=(WINDOW_FRAME,))),
}
ALL = Errors()
_PLACED = ("flush", "gap", "bond")
# Sphere scans, part scans and moves of the gripper; what is not named is exact.
SOURCES = {
    "nothing: what fit and seam leave by themselves": (EXACT, EXACT, EXACT),
    "the scanner's noise": (EXACT, replace(EXACT, noise=ALL.noise), EXACT),
    "the robot while it scans": (EXACT, replace(EXACT, turn=ALL.turn, shift=ALL.shift), EXACT),
    "the rail while it scans": (EXACT, replace(EXACT, rail=ALL.rail), EXACT),
    "the hand-eye, calibrated with all of them": (ALL, EXACT, EXACT),
    "robot and rail while they grip and place": (EXACT, EXACT, ALL),
    "all together": (ALL, ALL, ALL),
}


def jobs(seeds: range) -> Iterator[Row]:
    """Every case and a pane set a little wrong, for each turn of the part."""
    for case in CASES:
        yield from ({"part": "fit", "case": case, "seed": seed} for seed in seeds)
    yield from ({"part": "seam", "seed": seed} for seed in seeds)


def _fit(job: Row) -> Row:
    """Furthest that the pose's error moves any point of the part, at the start and after the fit, mm."""
    mesh, _ = part_of(CASES[job["case"]][0])
    T = turned(job["seed"])
    _, start, fit = fitted_case(job["case"], job["seed"])
    return {
        "start": furthest(start, T, mesh),
        "end": furthest(fit.T_base_part, T, mesh),
        "rms": fit.rms,
        "share": fit.inliers,
    }


def fitted_case(case: str, seed: int) -> tuple[JoinedScans, Array, CadFit]:
    """Return scans of a case, the pose (4, 4) that the fit starts from, and the fit."""
    kind, weld, (overview, close), regions = CASES[case]
    mesh, surface = part_of(kind)
    scan = scanned(mesh if weld is None else window_scans.warp(mesh, weld), kind, seed, overview, close)
    start = find_cad_start(scan, surface)[0]
    return scan, start, fit_cad(scan, surface, start, regions)


@cache
def part_of(kind: str) -> tuple[trimesh.Trimesh, CadSurface]:
    """Return the mesh of door or pane, and its surface."""
    mesh = car_door.build_pane() if kind == "pane" else car_door.build()
    return mesh, cad_surface(mesh)


def turned(seed: int) -> Array:
    """Return (4, 4) any turn, about where the source's body stands."""
    return frames.make(Rotation.random(rng=np.random.default_rng(seed)).as_matrix(), [3567.7, -2954.3, 1932.9])


def scanned(mesh: trimesh.Trimesh, kind: str, seed: int, overview: slice, close: slice) -> JoinedScans:
    """Return overview scans and close scans along the edges."""
    T = turned(seed)
    far, far_poses = window_scans.scan_outside(mesh, T, NOISE, seed, (3, 1) if kind == "pane" else (3, 3))
    shape = Pane() if kind == "pane" else CarDoor()
    near, near_poses = window_scans.scan_edges(mesh, T, shape, kind, NOISE, seed + 50)
    return joined(far[overview] + near[close], np.concatenate([far_poses[overview], near_poses[close]]))


def joined(clouds: list[Array], poses: Array) -> JoinedScans:
    """Return clouds as one scan."""
    return join_scans([prepare_scan("", points) for points in clouds], poses)


def furthest(T: Array, true: Array, mesh: trimesh.Trimesh) -> float:
    """Return the largest distance between where two poses put a point of the part, mm."""
    off = frames.transform(T, mesh.vertices) - frames.transform(true, mesh.vertices)
    return float(np.linalg.norm(off, axis=1).max())


def _seam(job: Row) -> Row:
    """Flush and gap at eight stations against the meshes cut there, of a pane set a little wrong."""
    middle, across, out = window_views.stations(Pane())
    places = [Station(str(i + 1), *v) for i, v in enumerate(zip(middle, across, out, strict=True))]
    pane, (door, _) = car_door.build_pane(), part_of("door")
    rng = np.random.default_rng(job["seed"])
    centre = frames.make(np.eye(3), pane.centroid)
    push = np.concatenate([rng.normal(size=3) * 1e-3, rng.normal(size=3) * 0.5])
    pane.apply_transform(centre @ frames.exp(push) @ frames.inverse(centre))
    T = turned(job["seed"])
    scan = joined(*window_scans.scan_seam([door, pane], T, (middle, across, out), NOISE, job["seed"]))
    measured = measure_seam(scan, T, places, Limits())
    return {
        "true": [list(map(float, window_scans.true_seam(pane, door, s.T_part_station))) for s in places],
        "measured": [[m.flush, m.gap] for m in measured],
        "sigmas": [[m.sigma_flush, m.sigma_gap] for m in measured],
        "verdicts": [m.verdict for m in measured],
    }


def _fit_table(rows: list[Row]) -> list[str]:
    lines = []
    for case, group in grouped(rows, "case").items():
        start, end = (max(row[key] for row in group) for key in ("start", "end"))
        rms, share = (np.mean([row[key] for row in group]) for key in ("rms", "share"))
        lines.append([case, f"{start:.2f}", f"{end:.4f}", f"{rms:.3f}", f"{share:.0%}"])
    lines.append(["published: body / window", "", "", "1.052 / 0.573", ""])
    head = "part | start / mm | after the fit, largest / mm | rms of distances / mm | share that counts"
    title = f"Furthest that the pose's error moves any point of the part, {len(group)} turns of it; noise {NOISE} mm."
    return [title, "", *markdown(head, lines)]


def _seam_table(rows: list[Row]) -> list[str]:
    true, measured, sigma = (np.array([row[key] for row in rows]) for key in ("true", "measured", "sigmas"))
    error = (measured - true).reshape(-1, 2)
    sigma = sigma.reshape(-1, 2)
    figures = {
        "error, rms": np.sqrt((error**2).mean(0)),
        "error, largest": np.abs(error).max(0),
        "stated sigma, mean": sigma.mean(0),
        "error over stated sigma, rms": np.sqrt(((error / sigma) ** 2).mean(0)),
    }
    stations = [
        [k, f"{flush:+.3f}", f"{t[0]:+.3f}", f"{gap:.3f}", f"{t[1]:.3f}", verdict]
        for k, ((flush, gap), t, verdict) in enumerate(
            zip(measured[-1], true[-1], rows[-1]["verdicts"], strict=True), 1
        )
    ]
    return [
        f"Seam, {len(rows)} panes set a little wrong, eight stations each.",
        "",
        *markdown("of it | flush / mm | gap / mm", ([n, f"{v[0]:.4f}", f"{v[1]:.4f}"] for n, v in figures.items())),
        "",
        "The last pane (limits: flush 0 ± 1.5, gap 16 ± 2 mm):",
        "",
        *markdown("station | flush / mm | true | gap / mm | true | verdict", stations),
    ]


PARTS = Parts({"fit": (_fit, _fit_table), "seam": (_seam, _seam_table)})
TABLE = Table(jobs, PARTS.trial, PARTS.summary, range(3), page="window", block="tables")


def line_jobs(seeds: range, keep: str) -> Iterator[Row]:
    """A line for every source of errors and seed; the files of the last one stay in the folder `keep`."""
    for source in SOURCES:
        yield from ({"source": source, "seed": seed, "keep": keep} for seed in seeds)


def line_trial(job: Row) -> Row:
    """Scan, calibrate, fit, grip, place, measure."""
    sphere, scans, moves = SOURCES[job["source"]]
    with TemporaryDirectory() as scratch:
        folder = Path(job["keep"] if job["keep"] and job["source"] == "all together" else scratch)
        line = WindowLine(job["seed"], scans, sphere, moves)
        hand_eye_and_fits(folder, line)
        T_cell_window = line.T_cell_window
        place_window(folder, line)
        write_seam(folder, line)
        _command("seam", folder / "seam.toml", "-o", folder / "seam.csv")
        return _against_truth(folder, line, T_cell_window)


def hand_eye_and_fits(folder: Path, line: WindowLine) -> None:
    """Everything before the window is gripped, by commands; an exact sphere's hand-eye is the true one."""
    write_line(folder, line)
    if line.sphere_errors == EXACT:
        document = {"hand_eye": line.T_flange_scanner.tolist(), "length_unit": "mm"}
        (folder / "hand-eye.json").write_text(json.dumps(document))
    else:
        _command("calibrate", "sphere", folder / "sphere", "-o", folder / "hand-eye.json")
    for part in ("window", "body"):
        _command("fit", folder / f"{part}.toml", "-o", folder / f"found-{part}")


def place_window(folder: Path, line: WindowLine) -> None:
    """Grip and place by the corrected paths."""
    line.place(path_end(folder, "window"), path_end(folder, "body"))


def path_end(folder: Path, part: str) -> Array:
    """Return the last pose (4, 4) of the path that was corrected for a part."""
    return poses_from_columns(read_columns(folder / f"found-{part}" / "path.csv", "name", POSE_COLUMNS))[-1]


def _command(*arguments: object) -> None:
    """One command of stitch, as a shell would give it."""
    printed = StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(printed):
            stitch([str(a) for a in arguments])
    except SystemExit as stop:
        if stop.code:
            raise RuntimeError(f"stitch {' '.join(map(str, arguments))}: {printed.getvalue()}") from None


def _against_truth(folder: Path, line: WindowLine, T_cell_window: Array) -> Row:
    """Everything that was found against what only the simulator knows, mm; T_cell_window (4, 4) is that in the rack."""
    hand_eye = np.array(json.loads((folder / "hand-eye.json").read_text())["hand_eye"])
    place = np.array([[0.0, 0.0, 500.0]])
    off = frames.transform(hand_eye, place) - frames.transform(line.T_flange_scanner, place)
    fits = [json.loads((folder / f"found-{part}" / "fit.json").read_text()) for part in ("window", "body")]
    T_window, T_body = (np.array(fit["parts"][0]["T_base_part"]) for fit in fits)
    T_body_window = frames.inverse(line.T_cell_body) @ line.T_cell_window
    window = line.window_mesh.copy().apply_transform(T_body_window)
    stations = [Station("", *v).T_part_station for v in zip(*line.stations(), strict=True)]
    true = np.array([window_scans.true_seam(window, line.body_mesh, T) for T in stations])
    drawn = np.array([window_scans.true_seam(line.window_mesh, line.body_mesh, T) for T in stations])
    with (folder / "seam.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    measured = np.array([[float(row["flush"]), float(row["gap"])] for row in rows])
    return {
        "hand_eye": float(np.linalg.norm(off)),  # at the scanner's standoff
        "window": furthest(T_window, T_cell_window, line.window_mesh),
        "body": furthest(T_body, line.T_cell_body, line.body_mesh),
        "placed": furthest(T_body_window, np.eye(4), line.window_mesh),  # from its design place in the true body
        "seam": (measured - true).tolist(),  # (8, 2) flush and gap
        "sigma": [[float(row["sigma_flush"]), float(row["sigma_gap"])] for row in rows],
        "asked": (true - drawn).tolist(),
        "over_sigma": [
            _over_sigma(fits[0]["parts"][0], T_cell_window, line.window_mesh),
            _over_sigma(fits[1]["parts"][0], line.T_cell_body, line.body_cad),
        ],
    }


def _over_sigma(part: Row, T_true: Array, cad: trimesh.Trimesh) -> list[float]:
    """Six numbers of a found pose about the CAD's centre, over their stated sigmas."""
    centre = frames.make(np.eye(3), cad.bounds.mean(axis=0))
    off = frames.log(frames.inverse(np.array(part["T_base_part"]) @ centre) @ T_true @ centre)
    return (off / np.concatenate([np.radians(part["sigma_deg"]), part["sigma"]])).tolist()


def line_summary(rows: list[Row]) -> list[str]:
    """The error budget."""
    lines = []
    for source, group in grouped(rows, "source").items():
        columns = [np.array([row[key] for row in group]) for key in ("hand_eye", "window", "body", "placed")]
        asked, seam = (np.array([row[key] for row in group]) for key in ("asked", "seam"))
        cells = [f"{_rms(values):.3f}, {values.max():.3f}" for values in columns]
        lines.append([source, *cells, f"{_rms(asked):.3f}", f"{_rms(seam):.3f}", f"{np.abs(seam).max():.3f}"])
    ratio = _rms(seam / np.array([row["sigma"] for row in group]))
    window, body = (_rms(z) for z in np.array([row["over_sigma"] for row in group]).transpose(1, 0, 2))
    head = "switched on | hand-eye at 500 mm | window in the rack | body | window set against its design place"
    more = "flush and gap set, rms of 8 places | seam measured against its truth, rms | largest"
    return [
        f"{len(group)} lines for each row; mm. Rms over the lines, and the largest. A pose counts by the point of its "
        "part that it moves furthest.",
        "",
        *markdown(f"{head} | {more}", lines),
        "",
        f"Error over its stated sigma with all errors, rms: seam {ratio:.2f}; six numbers of the window's pose "
        f"{window:.2f}, of the body's {body:.2f}.",
    ]


def _rms(values: Array, axis: int | None = None) -> Array:
    return np.sqrt((values**2).mean(axis=axis))


def bond_trial(job: Row) -> Row:
    """How a window will sit at its stations, asked before it is gripped, against how it then sat (8, 3): flush, gap,
    bond gap."""
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        line = WindowLine(job["seed"], sizes={"rebate": 30.0})
        hand_eye_and_fits(folder, line)
        _command("seam", folder / "before.toml", "-o", folder / "before.csv")
        place_window(folder, line)
        window = line.window_mesh.copy().apply_transform(frames.inverse(line.T_cell_body) @ line.T_cell_window)
        stations = [Station("", *v).T_part_station for v in zip(*line.stations(), strict=True)]
        flange = -line.pane.gap / 2 - 7.0  # the middle of what of it lies behind the pane
        true = [
            [
                *window_scans.true_seam(window, line.body_mesh, T),
                window_scans.true_bond_gap(window, line.body_mesh, T, flange),
            ]
            for T in stations
        ]
        with (folder / "before.csv").open() as stream:
            rows = list(csv.DictReader(stream))
    said, sigma = ([[float(row[head + key]) for key in _PLACED] for row in rows] for head in ("", "sigma_"))
    return {"true": np.array(true).tolist(), "said": said, "sigma": sigma}


def bond_summary(rows: list[Row]) -> list[str]:
    """One row for each of what is said."""
    true, said, sigma = (np.array([row[key] for row in rows]).reshape(-1, 3) for key in ("true", "said", "sigma"))
    off = said - true
    columns = np.column_stack([true.min(axis=0), true.max(axis=0), *(_rms(v, 0) for v in (off, sigma, off / sigma))])
    lines = [(name, *(f"{v:.3f}" for v in line)) for name, line in zip(_PLACED, columns, strict=True)]
    title = f"Said before placing against what then was, {len(rows)} lines, eight places each; mm."
    return [title, "", *markdown("what | from | to | error, rms | sigma, rms | error over sigma, rms", lines)]


BOND = Table(
    lambda seeds: ({"seed": seed} for seed in seeds), bond_trial, bond_summary, range(5), page="window", block="bond"
)
LINE = Table(line_jobs, line_trial, line_summary, range(5), page="window", block="line", settings={"keep": ""})
