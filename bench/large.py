"""Large sessions: seconds, memory and distance from the truth over points a view and over views.

Run: python bench/large.py FOLDER [--most 2e8]; panels of `large_panel.py` are written into FOLDER (30 MB
for a view of a million points) and kept; a row for each run is appended to FOLDER/large.jsonl, and the tables go into
docs/large-sessions.md. A run that stands there is not repeated.
"""

import argparse
import itertools
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from batch import into_page
from large_panel import distance, write_panel
from plyfile import PlyData

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "large-sessions.md"
_VIEWS, _POINTS = (10, 30, 100, 300), (10_000, 100_000, 1_000_000, 10_000_000)
# Views at which points grow, and points at which views grow; the largest of both.
_AT_VIEWS, _AT_POINTS = 18, 20_000
_LARGEST = (200, 1_000_000)
_COLUMNS = "| views | points a view | million points | s | CPU s | s per million | memory, GB | median µm | 95 % µm |"


def measured(folder: Path, views: int, points: int) -> dict[str, Any]:
    """One run of the whole command, page included, recording not."""
    name = f"panel-{views}-{points}"
    session = folder / name
    if not session.is_dir():
        write_panel(session, views, points)
    run = folder / f"run-{name}"
    command = [
        sys.executable,
        "-c",
        "from stitch.cli.main import main; main()",
        "run",
        str(session),
        "-o",
        str(run),
        "--no-recording",
        "--force",
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    begun = time.perf_counter()
    process = subprocess.Popen([*command, "--memory", "3GB"], env=environment, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begun
    assert status == 0, command
    vertex = PlyData.read(str(run / "stitched.ply"))["vertex"].data
    some = vertex[:: max(1, len(vertex) // 1_000_000)]
    off = np.abs(distance(np.column_stack([some[axis] for axis in "xyz"]).astype(float)))
    return {
        "views": views,
        "points": points,
        "all": sum(row["points"] for row in json.loads((run / "result.json").read_text())["views"]),
        "seconds": seconds,
        "cpu": used.ru_utime + used.ru_stime,
        "memory": used.ru_maxrss / 1e6,
        "median": float(np.median(off)),
        "most": float(np.quantile(off, 0.95)),
        "stages": {s["name"]: s["seconds"] for s in json.loads((run / "result.json").read_text())["stages"]},
        "load": os.getloadavg()[0],
    }


def table(rows: list[dict[str, Any]]) -> list[str]:
    """The rows, with the exponent of the processor's seconds over the last factor of points or views."""
    return [
        _COLUMNS,
        "|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
        *map(_line, rows),
    ]


def _line(r: dict[str, Any]) -> str:
    size = f"| {r['views']} | {r['points']:,} | {r['all'] / 1e6:.2f}"
    cost = f"| {r['seconds']:.1f} | {r['cpu']:.1f} | {1e6 * r['seconds'] / r['all']:.2f} | {r['memory']:.2f}"
    return f"{size} {cost} | {1e3 * r['median']:.1f} | {1e3 * r['most']:.1f} |"


def exponent(rows: list[dict[str, Any]], key: str) -> str:
    """d log(CPU s) / d log(key) between neighbouring rows."""
    steps = [np.log(b["cpu"] / a["cpu"]) / np.log(b[key] / a[key]) for a, b in itertools.pairwise(rows)]
    return ", ".join(f"{step:.2f}" for step in steps)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--most", type=float, default=2e8, help="points of all views; larger panels are left out")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    file = given.folder / "large.jsonl"
    known = (
        {(r["views"], r["points"]): r for r in map(json.loads, file.read_text().splitlines())} if file.exists() else {}
    )
    by_points, by_views = [(_AT_VIEWS, p) for p in _POINTS], [(v, _AT_POINTS) for v in _VIEWS]
    for case in [*by_points, *by_views, _LARGEST]:
        if case not in known and case[0] * case[1] <= given.most:
            known[case] = measured(given.folder, *case)
            with file.open("a") as out:
                out.write(json.dumps(known[case]) + "\n")
    of_points, of_views = ([known[c] for c in cases if c in known] for cases in (by_points, by_views))
    lines = []
    for key, rows in (("points", of_points), ("views", of_views)):
        grown = f"CPU seconds go with the number of {key} to the power of {exponent(rows, key)}, from row to row."
        lines += [f"**More {key}**", "", *table(rows), "", grown, ""]
    if _LARGEST in known:
        lines += ["**More of both**", "", *table([known[_LARGEST]])]
    print("\n".join(lines))
    into_page("large", lines, PAGE)


if __name__ == "__main__":
    main()
