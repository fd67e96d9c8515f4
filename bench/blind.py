"""Can the diagnosis be trusted? Hidden effects on simulated cells, judged blind.

Usage: python bench/blind.py [--part effects,empty,aliases,outside,pairs] [--seeds N] [--rows FILE] [--tables]

Sizes are multiples of the smallest detectable size of each effect in each cell, which is computed from the
same cell with nothing hidden. Rows are appended to FILE as they come, and trials that are in it are not run
again; --tables only prints the tables of what is there. Hours on two cores.
"""

import argparse
import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import count
from multiprocessing import get_context
from os import cpu_count
from pathlib import Path

import numpy as np
from blind_cells import HARD, LAST_JOINT, OUTSIDE
from blind_tables import tables
from blind_trials import LIBRARY, Row, pin, trial

SCENES = ("blade", "drill-plate", "blade-table")
MULTIPLES = (2.0, 1.0, 4.0, 0.5)
PARTS = ("effects", "empty", "aliases", "outside", "pairs")


def jobs(part: str, seeds: int, scenes: tuple[str, ...]) -> Iterator[Row]:
    """All trials of a part; `seeds` cells a scene for effects and what is outside the library."""
    cells = [{"part": part, "scene": scene, "seed": seed} for seed in range(seeds) for scene in scenes]
    if part == "effects":
        yield from ({**c, "effect": e, "multiple": m} for c in cells for e in LIBRARY for m in MULTIPLES)
    elif part == "empty":
        for i in range(100):
            yield {"part": part, "scene": scenes[i % len(scenes)], "seed": 1000 + i, "noise": ""}
            if i % 2:
                noise = list(HARD)[i // 2 % len(HARD)]
                yield {"part": part, "scene": scenes[i % len(scenes)], "seed": 2000 + i, "noise": noise}
    elif part == "aliases":
        for i in range(20):
            cell = {"part": part, "scene": "blade", "seed": 3000 + i, "amplitude": (1.0, 2.0)[i % 2]}
            yield {**cell, "effect": "joint_offset", "how": "", "useful": [0]}
            yield {**cell, "effect": "joint_offset", "how": LAST_JOINT}
    elif part == "outside":
        yield from ({**c, "seed": 4000 + 10 * k + c["seed"], "effect": e, "multiple": m}
                    for k in range(3) for c in cells for m in (2.0, 4.0) for e in OUTSIDE)  # fmt: skip
    elif part == "pairs":
        rng = np.random.default_rng(5)
        for i in range(30):
            two = [str(e) for e in rng.choice(LIBRARY, 2, replace=False)]
            yield {"part": part, "scene": scenes[i % len(scenes)], "seed": 5000 + i // 10, "effects": two,
                   "multiple": 4.0}  # fmt: skip


def key(row: Row) -> str:
    """What names a trial."""
    names = ("part", "scene", "seed", "effect", "effects", "multiple", "noise", "how", "useful", "amplitude")
    return json.dumps({name: row[name] for name in names if name in row})


def run_all(todo: list[Row], file: Path) -> None:
    """Trials over the cores; rows are appended as they come."""
    cores = cpu_count() or 1
    context = get_context("spawn")
    number = context.Value("i", 0)
    with ProcessPoolExecutor(cores, context, initializer=_begin, initargs=(number,)) as pool, file.open("a") as out:
        for k, done in zip(count(1), as_completed([pool.submit(trial, job) for job in todo]), strict=False):
            out.write(json.dumps(done.result()) + "\n")
            out.flush()
            print(f"\r{k} of {len(todo)}", end="", flush=True)
    print()


def _begin(number) -> None:
    with number.get_lock():
        number.value += 1
        pin(number.value)


def main() -> None:
    """Run the parts asked for and print their tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--part", default=",".join(PARTS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--effects", default="", help="only these")
    parser.add_argument("--rows", type=Path, default=Path("runs/blind.jsonl"))
    parser.add_argument("--tables", action="store_true", help="print the tables and run nothing")
    options = parser.parse_args()
    options.rows.parent.mkdir(parents=True, exist_ok=True)
    if not options.tables:
        wanted = set(options.effects.split(",")) - {""}
        todo = [j for part in options.part.split(",")
                for j in jobs(part, options.seeds, tuple(options.scenes.split(",")))
                if not wanted or wanted & {j.get("effect"), *j.get("effects", ())}]  # fmt: skip
        # In any order, so that whatever has been run so far is a fair sample.
        todo = [todo[i] for i in np.random.default_rng(0).permutation(len(todo))]
        done = {key(row) for row in _rows(options.rows)}
        run_all([job for job in todo if key(job) not in done], options.rows)
    print(tables(_rows(options.rows)))


def _rows(file: Path) -> list[Row]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []


if __name__ == "__main__":
    main()
