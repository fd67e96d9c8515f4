"""Conventions scrambled on purpose: does `stitch init` tell the right one? python bench/init.py [--tables]

The five objects of RegHEC, nine views each. Twelve orders of Euler angles × poses inverted or not, 24 tables an object;
axes that turn along or stand still, degrees or radians, mm or m, angles or positions first are drawn for each. Right:
order, direction, unit and mount as they were; wrong: told, but otherwise than they were. --tables writes the table of
docs/conventions-told.md.
"""

import argparse
import os
import re
import time
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np

from data_synth.fixtures.raw_folders import Convention, session_poses, table_of
from stitch.numerics import frames
from stitch.plugins.intake.cloud_pairs import pairings
from stitch.plugins.intake.convention_choice import choose_convention, choose_mounting
from stitch.plugins.intake.first_session import capture_of
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import StatedTable, all_readings, candidate_units
from stitch.screening.conventions import register_scan_pairs
from stitch.screening.hypotheses import ORDERS
from stitch.session.capture import Capture
from stitch.session.reading.clouds import read_cloud

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "conventions-told.md"
SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or ROOT.parent / "shared" / "data")
OBJECTS = dict.fromkeys(("david", "cone", "sphere", "rubik"), "eye_in_hand") | {"gripperopen": "eye_to_hand"}
BEGIN, END = "<!-- scrambled: begin -->\n", "<!-- scrambled: end -->"


def conventions(seed: int) -> list[Convention]:
    """One table for each order and direction, the rest drawn."""
    rng = np.random.default_rng(seed)
    out = []
    for order in ORDERS:
        for inverse in (False, True):
            along, degrees, first = rng.integers(2, size=3).astype(bool)
            out.append(
                Convention(
                    order=order if along else order.lower(),
                    degrees=bool(degrees),
                    inverse=inverse,
                    unit=("mm", "m")[rng.integers(2)],
                    angles_first=bool(first),
                )
            )
    return out


class Cell:
    """The scans of an object, prepared once: they are the same under every table."""

    def __init__(self, name: str, views: int) -> None:
        self.folder, self.mount = SHARED / "reghec" / name, OBJECTS[name]
        T, clouds = session_poses(self.folder)
        self.T, self.clouds = T[:views], [self.folder / cloud for cloud in clouds[:views]]
        self.capture: Capture = capture_of([read_cloud(cloud) for cloud in self.clouds], 1000.0)
        self.motions = cache(lambda: register_scan_pairs(self.capture))

    def outcome(self, convention: Convention) -> tuple[str, str]:
        """ "right", "cannot be told" or "wrong", and what was said."""
        numbers = np.round(table_of(self.T, convention), 7)
        raw = RawPoses("table", None, numbers, ((),) * len(numbers), "")
        found = all_readings(raw, None, StatedTable())
        pairs = pairings(self.clouds, raw.labels)
        decided = choose_convention(self.capture, self.motions, found, pairs, candidate_units(found, StatedTable()))
        settled = choose_mounting(decided, None, None)
        way = decided.best.interpretation
        said = f"{way.reading.words}, {way.length_unit}, {settled.mount}{', inverted' * settled.inverted}"
        said += f" ({decided.best.misfit:.2f} mm, next {decided.runner_up.misfit if decided.runner_up else 0:.2f})"
        if not (decided.determined and settled.guess.determined):
            return "cannot be told", said
        T = settled.flange(way.T)
        turned = frames.angle_between(T, self.T).max() < 1e-5
        right = turned and np.abs(T - self.T)[:, :3, 3].max() < 0.01 and settled.mount == self.mount
        return ("right" if right else "wrong"), said


def main() -> None:
    """Print a line a table and the counts; with --tables write them into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tables", action="store_true", help="write the table of docs/conventions-told.md")
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=list(OBJECTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--views", type=int, default=9, help="the first so many of nine")
    asked = parser.parse_args()
    rows, spent = {}, time.process_time()
    for number, name in enumerate(asked.objects):
        cell, counts = Cell(name, asked.views), Counter[str]()
        for convention in conventions(asked.seed + number):
            result, said = cell.outcome(convention)
            counts[result] += 1
            print(f"{name:12} {result:15} {convention} → {said}", flush=True)
        rows[name] = counts
    words = ("right", "cannot be told", "wrong")
    table = ["| object | " + " | ".join(words) + " |", "|---|---|---|---|"]
    table += [f"| {name} | " + " | ".join(str(counts[w]) for w in words) + " |" for name, counts in rows.items()]
    total = sum(rows.values(), Counter())
    table.append("| all | " + " | ".join(f"{total[w]} of {sum(total.values())}" for w in words) + " |")
    print("\n".join(table), f"\n{(time.process_time() - spent) / sum(total.values()):.1f} s of one core a table")
    if asked.tables:
        text = PAGE.read_text(encoding="utf-8")
        new = re.sub(f"{BEGIN}.*?{END}", lambda _: f"{BEGIN}{chr(10).join(table)}\n{END}", text, flags=re.DOTALL)
        PAGE.write_text(new, encoding="utf-8")


if __name__ == "__main__":
    main()
