"""Motions and hand-eye from the odometry of ordered scans: python -m bench.odometry [--seeds N] [--write].

A stream of a scanner that never stops (`moving-scan`), from the stated hand-eye, which is off by centimetres, and from
none, with and without its de-skew, and the same path two and a half times as fast, in 40 scans for 100; beside them
separate views of the same arm (`blade-table`). A step is right where it places the middle of the scan within 3 % of the
part's size and within a quarter of how far it moved. The hand-eye is off by what it moves a point at the working
distance.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from data_synth.scene import load_scene
from data_synth.simulate import Measured, simulate
from data_synth.write import write_session
from stitch.api.pipeline import run
from stitch.numerics.frames import Array
from stitch.numerics.odometry import hand_eye_of_stream, is_stream, motions_between, size_of_scan
from stitch.session.reading.session_folder import load_session

PAGE = Path(__file__).resolve().parents[1] / "docs" / "session.md"
BEGIN, END = "<!-- odometry: begin -->", "<!-- odometry: end -->"
_SAME, _OF_MOTION = 0.03, 0.25
# Scans of the path at two and a half times the speed.
_FAST = 40


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


def of_odometry(measured: Measured, deskewed: bool, stated: bool) -> dict[str, float]:
    """Right steps, of how many, whether the scans count as a stream, and how far the hand-eye is off, mm."""
    scans, T = [cloud.points for cloud in measured.clouds], measured.T_base_flange
    times = [cloud.time for cloud in measured.clouds if cloud.time is not None] if deskewed else None
    T_mount, odometry = hand_eye_of_stream(
        T, scans, times, 1 / measured.scene.plan.rate, measured.T_coarse if stated else None
    )
    right, of = right_steps(measured, odometry)
    off = float("nan") if T_mount is None else hand_eye_error(measured, T_mount)
    return {"right": right, "of": of, "stream": is_stream(T, scans), "off": off}


def of_run(measured: Measured) -> dict[str, float]:
    """How far the hand-eye of a whole run is off, mm."""
    with tempfile.TemporaryDirectory() as folder:
        write_session(Path(folder) / "s", measured, "s")
        return {"off": hand_eye_error(measured, run(load_session(Path(folder) / "s")).T_mount)}


def of_seed(seed: int) -> dict[str, dict[str, float]]:
    """Every row's numbers for one seed."""
    stream, fast, separate = (
        simulate(load_scene(name), {}, seed, n)
        for name, n in (("moving-scan", None), ("moving-scan", _FAST), ("blade-table", None))
    )
    return {
        "`moving-scan`, odometry from the stated hand-eye": of_odometry(stream, True, True),
        "the same from none": of_odometry(stream, True, False),
        "the same from the stated one, not de-skewed": of_odometry(stream, False, True),
        "`moving-scan`, the whole run": of_run(stream),
        "2.5 times as fast, odometry from the stated hand-eye": of_odometry(fast, True, True),
        "2.5 times as fast, the whole run": of_run(fast),
        "`blade-table`, separate views, odometry from the stated hand-eye": of_odometry(separate, False, True),
        "`blade-table`, the whole run": of_run(separate),
    }


def table(seeds: list[dict[str, dict[str, float]]], first: int) -> list[str]:
    """Steps of all seeds together; of the hand-eyes the middle and the range."""
    lines = [
        f"{len(seeds)} seeds from {first} on. A motion from scan to scan is right within 3 % of the part's size and "
        "within a quarter of itself;",
        "the hand-eye is off by what it displaces a point at the working distance (median, range).",
        "",
        "| scans | taken for a stream | right motions | hand-eye off by (mm) |",
        "|---|---|---:|---:|",
    ]
    for name in seeds[0]:
        rows = [seed[name] for seed in seeds]
        off = np.array([row["off"] for row in rows])
        right, of = (sum(row.get(key, 0) for row in rows) for key in ("right", "of"))
        share = f"{right:.0f} of {of:.0f} ({100 * right / of:.0f} %)" if of else ""
        streams = f"{sum(row['stream'] for row in rows)} of {len(rows)}" if of else ""
        known = off[np.isfinite(off)]
        told = f"{np.median(known):.2f} ({known.min():.2f} … {known.max():.2f})" if len(known) else ""
        lost = f"; none in {len(off) - len(known)}" if len(known) < len(off) else ""
        lines.append(f"| {name} | {streams} | {share} | {told}{lost} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=4920)
    parser.add_argument("--keep", type=Path, help="seeds that are done; goes on from there")
    parser.add_argument("--write", action="store_true", help="put the table into docs/session.md")
    given = parser.parse_args()
    done = (
        [json.loads(line) for line in given.keep.read_text().splitlines()]
        if given.keep and given.keep.is_file()
        else []
    )
    for seed in range(given.first + len(done), given.first + given.seeds):
        done.append(of_seed(seed))
        if given.keep:
            with given.keep.open("a", encoding="utf-8") as file:
                file.write(json.dumps(done[-1]) + "\n")
    lines = table(done, given.first)
    print("\n".join(lines))
    if given.write:
        head, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
        PAGE.write_text("\n".join([head + BEGIN, *lines, END]) + rest.partition(END)[2], encoding="utf-8")


if __name__ == "__main__":
    main()
