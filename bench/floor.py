"""How far the stages are from what cannot be saved: one look at the neighbours of every point, and one at its partner.

Run: python bench/floor.py SESSION... (panels that `large.py` wrote, or any others); the table goes into
docs/large-sessions.md. Seconds of the clock, all cores.
"""

import argparse
import time
from itertools import pairwise
from pathlib import Path

from batch import into_page
from large import PAGE

import stitch
from stitch.numerics import frames
from stitch.session.capture import Capture, prepare_capture
from stitch.system.threads import library_threads_off, parallel


def floor(session: Path) -> tuple[int, float, Capture]:
    """Points, seconds of normals of all points and of one search for all of them, each in the view before it."""
    loaded = stitch.load_session(session, at_most=None)
    with library_threads_off():
        begun = time.perf_counter()
        own = prepare_capture(loaded)
        assert loaded.scanner.T_mount is not None
        poses = own.poses(loaded.scanner.T_mount)

        def searched(pair: tuple[int, int]) -> int:
            v, w = pair
            there = frames.transform(frames.inverse(poses[v]) @ poses[w], own.scans[w].points)
            return len(own.scans[v].tree.query(there, k=1, distance_upper_bound=3 * own.spacing)[0])

        views = range(len(own.scans))
        points = sum(parallel(searched, pairwise([views[-1], *views])))
        return points, time.perf_counter() - begun, own


def row(session: Path) -> str:
    """One session: the floor, and the stages of a run as multiples of it."""
    points, least, _ = floor(session)
    run = stitch.run(stitch.load_session(session))
    seconds = {stage.name: stage.seconds for stage in run.stages}
    times = " | ".join(f"{seconds[name]:.1f} | {seconds[name] / least:.2f}" for name in ("correct", "register"))
    return f"| {session.name} | {points / 1e6:.2f} | {least:.1f} | {times} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sessions", nargs="+", type=Path)
    lines = [
        "**The floor**: normals of all points, and one search for all of them",
        "",
        "| session | million points | floor, s | correct, s | times the floor | register, s | times the floor |",
        "|---|---:|---:|---:|---:|---:|---:|",
        *map(row, parser.parse_args().sessions),
    ]
    print("\n".join(lines))
    into_page("floor", lines, PAGE)


if __name__ == "__main__":
    main()
