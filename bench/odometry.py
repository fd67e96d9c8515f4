"""Motions and hand-eye from the odometry of ordered scans: python -m bench.odometry [--seeds N] [--motions].

A stream of a scanner that never stops (`moving-scan`), with and without its de-skew, beside separate views of the same
arm (`blade-table`). A step is right where it places the middle of the scan within 3 % of the part's size and
within a quarter of how far it moved. The hand-eye is off by what it moves a point at the working distance.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from data_synth.scene import load_scene
from data_synth.simulate import Measured, simulate
from data_synth.write import write_session
from stitch.closed_form.hand_eye import park_martin
from stitch.closed_form.odometry import is_stream, motions_between, scan_odometry, size_of_scan, turned_pairs
from stitch.errors import NoResultError
from stitch.frames import Array
from stitch.pipeline import run
from stitch.reading.session_folder import load_session

_SAME, _OF_MOTION = 0.03, 0.25


def right_steps(measured: Measured, odometry: Array) -> tuple[int, int]:
    """Return how many steps from scan to scan are right, and of how many."""
    scans = [cloud.points for cloud in measured.clouds]
    pairs = [(v, v + 1) for v in range(len(scans) - 1)]
    found, true = motions_between(odometry, pairs), motions_between(measured.T_reference_scanner, pairs)
    middle = np.array([np.append(points.mean(axis=0), 1.0) for points in scans[1:]])
    off = np.linalg.norm(np.einsum("nij,nj->ni", found - true, middle)[:, :3], axis=1)
    moved = np.linalg.norm(np.einsum("nij,nj->ni", true - np.eye(4), middle)[:, :3], axis=1)
    right = (off < _SAME * size_of_scan(scans[0])) & (off < _OF_MOTION * moved)
    return int(right.sum()), len(right)


def hand_eye_error(measured: Measured, T_mount: Array) -> float:
    """Return by how much a hand-eye displaces a point at the working distance, mm."""
    point = np.array([0.0, 0.0, measured.scene.scanner.standoff, 1.0])
    return float(np.linalg.norm(((T_mount - measured.T_mount) @ point)[:3]))


def row(name: str, measured: Measured, times: list[Array] | None) -> None:
    """Print one line of the table: shares, and the hand-eye from the odometry."""
    scans = [cloud.points for cloud in measured.clouds]
    odometry = scan_odometry(scans, times, 1 / measured.scene.plan.rate)
    right, of = right_steps(measured, odometry)
    pairs = turned_pairs(measured.T_base_flange)
    try:
        T_mount = park_martin(motions_between(measured.T_base_flange, pairs), motions_between(odometry, pairs))
        off = f"{hand_eye_error(measured, T_mount):.2f} mm"
    except NoResultError:
        off = "–"
    stream = "yes" if is_stream(measured.T_base_flange, scans) else "no"
    print(f"| {name} | {stream} | {right} of {of} ({100 * right / of:.0f} %) | {off} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--views", type=int, help="of the stream; default is the scene's")
    parser.add_argument("--motions", action="store_true", help="without the whole runs")
    given = parser.parse_args()
    print("| scans | taken for a stream | right motions | hand-eye from the odometry off by |\n|---|---|---:|---:|")
    for seed in range(given.seeds):
        stream, views = (
            simulate(load_scene(name), {}, seed, count)
            for name, count in (("moving-scan", given.views), ("blade-table", None))
        )
        row(f"stream {seed}, de-skewed", stream, [cloud.time for cloud in stream.clouds if cloud.time is not None])
        row(f"stream {seed}, as it is", stream, None)
        row(f"separate views {seed}", views, None)
        for name, measured in () if given.motions else (("stream", stream), ("separate views", views)):
            with tempfile.TemporaryDirectory() as folder:
                write_session(Path(folder) / "s", measured, name)
                found = run(load_session(Path(folder) / "s"))
            print(
                f"| {name} {seed}, the whole run | | | {hand_eye_error(measured, found.T_mount):.2f} mm |", flush=True
            )


if __name__ == "__main__":
    main()
