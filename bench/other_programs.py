"""Other programs on the same scans: Open3D's graph of poses, trimesh's ICP, KISS-ICP's odometry of a stream.

Open3D is `stitch compare --with open3d`; trimesh puts each view onto all before it. Both begin at the robot's poses
under the hand-eye of the run. What counts is how far points lie from where they are, the cloud put onto the truth; the
witness is right where it calls the program nearer whose points are.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from trimesh.registration import icp

import stitch
from bench.cells import points_off
from bench.harness import Parts, Row, Table, markdown, share
from data_synth.scene import load_scene
from data_synth.simulate import Measured, simulate
from data_synth.write import write_session
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.odometry import hand_eye_of_stream, motions_between, size_of_scan
from stitch.output.comparison.open3d_witness import open3d_witness

OURS, START, OPEN3D, TRIMESH = "`stitch run`", "the robot's poses under its hand-eye", "Open3D", "trimesh"
# Points of a view that trimesh is given, how near they begin, mm, and its steps: the best of some that were tried.
_POINTS, _NEAR, _STEPS = 5_000, 0.5, 50
# A motion from scan to scan is right within so much of the part's size and of itself.
_SAME, _OF_MOTION = 0.03, 0.25


def jobs(seeds: range) -> Iterator[Row]:
    """Yield every trial."""
    for seed in seeds:
        yield {"part": "clouds", "seed": seed}
        yield {"part": "odometry", "seed": seed}


def _run(measured: Measured) -> stitch.Run:
    with tempfile.TemporaryDirectory() as folder:
        write_session(Path(folder) / "s", measured, "s")
        return stitch.run(stitch.load_session(Path(folder) / "s"))


def clouds(job: Row) -> Row:
    """Return how far each program's points lie from where they are (µm: median, 95 %), and whom the witness prefers."""
    measured = simulate(load_scene("blade"), {}, job["seed"])
    run = _run(measured)
    counted = [int(name.removeprefix("v")) for name in run.session.names]
    points = [measured.clouds[v].points for v in counted]
    witness = open3d_witness(run)
    by_program = {
        OURS: run.poses,
        START: run.poses_model,
        OPEN3D: witness.poses,
        TRIMESH: _by_trimesh(points, run.poses_model),
    }
    true = measured.T_reference_scanner[counted]
    off = {
        name: (1e3 * np.quantile(points_off(points, poses, true), (0.5, 0.95))).tolist()
        for name, poses in by_program.items()
    }
    return {"off": off, "said": witness.sentences("mm")[-1]}


def _by_trimesh(points: list[Array], start: Array) -> Array:
    """Return poses of the views, each put onto all before it from where the first leads."""
    poses, placed = [start[0]], frames.transform(start[0], points[0])
    for v in range(1, len(points)):
        seen = frames.transform(start[v], points[v])
        # It pairs every point, so it is given those that the others saw.
        meets = seen[cKDTree(placed).query(seen)[0] < _NEAR]
        some = meets[:: max(len(meets) // _POINTS, 1)]
        moved, _, _ = icp(some, placed, max_iterations=_STEPS, reflection=False, scale=False)
        poses.append(moved @ start[v])
        placed = np.concatenate([placed, frames.transform(moved, seen)])
    return np.array(poses)


def odometry(job: Row) -> Row:
    """Return how many of KISS-ICP's motions are right, and how far its hand-eye and the whole run's are off, mm."""
    measured = simulate(load_scene("moving-scan"), {}, job["seed"])
    scans = [cloud.points for cloud in measured.clouds]
    times = [cloud.time for cloud in measured.clouds if cloud.time is not None]
    T_mount, poses = hand_eye_of_stream(
        measured.T_base_flange, scans, times, 1 / measured.scene.plan.rate, measured.T_coarse
    )
    pairs = [(v, v + 1) for v in range(len(scans) - 1)]
    found, true = motions_between(poses, pairs), motions_between(measured.T_reference_scanner, pairs)
    middles = np.array([np.append(cloud.mean(axis=0), 1.0) for cloud in scans[1:]])[..., None]
    off, moved = (np.linalg.norm((moves @ middles)[:, :3, 0], axis=1) for moves in (found - true, true - np.eye(4)))
    right = (off < _SAME * size_of_scan(scans[0])) & (off < _OF_MOTION * moved)
    hand_eyes = {"KISS-ICP": T_mount, OURS: _run(measured).T_mount}
    point = np.array([0.0, 0.0, measured.scene.scanner.standoff, 1.0])
    return {
        "right": right.tolist(),
        "off": {
            name: None if T is None else float(np.linalg.norm(((T - measured.T_mount) @ point)[:3]))
            for name, T in hand_eyes.items()
        },
    }


def _spread(values: list[float], digits: int) -> str:
    return f"{np.median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def _cloud_lines(rows: list[Row]) -> list[str]:
    table = []
    for name in (OURS, START, OPEN3D, TRIMESH):
        middle, most = ([row["off"][name][i] for row in rows] for i in (0, 1))
        nearer = "–" if name == OURS else share(row["off"][OURS][1] < row["off"][name][1] for row in rows)
        table.append((name, _spread(middle, 0), _spread(most, 0), nearer))
    witness = share(
        ("This run is nearer" in row["said"] and "beyond chance" not in row["said"])
        == (row["off"][OURS][1] < row["off"][OPEN3D][1])
        for row in rows
    )
    head = "program | half of the points within, µm | 95 % within, µm | `stitch run` nearer"
    return [*markdown(head, table), "", f"The witness called the side that is nearer in {witness} cells."]


def _odometry_lines(rows: list[Row]) -> list[str]:
    table = []
    for name in ("KISS-ICP", OURS):
        off = [row["off"][name] for row in rows if row["off"][name] is not None]
        right = share(x for row in rows for x in row["right"]) if name == "KISS-ICP" else "–"
        table.append((name, f"{len(off)} of {len(rows)}", right, _spread(off, 2)))
    head = "program | hand-eye found | right motions | hand-eye off at the part, mm: median (smallest to largest)"
    return markdown(head, table)


_PARTS = Parts({"clouds": (clouds, _cloud_lines), "odometry": (odometry, _odometry_lines)})
TABLE = Table(jobs, _PARTS.trial, _PARTS.summary, range(5100, 5110), page="results", block="other-programs")
