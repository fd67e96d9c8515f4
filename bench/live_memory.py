"""Memory of a run from arrays against that of a run from the folder of the same scans: a table of docs/python.md.

Run: python bench/live_memory.py FOLDER; sessions of `large_panel.py` are written into FOLDER and kept. Each run is a
process of its own, and its memory the most that was ever resident (VmHWM), that of libraries included.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from batch import into_page
from large_panel import write_panel

import stitch

PAGE = Path(__file__).resolve().parents[1] / "docs" / "python.md"
VIEWS, POINTS = 18, (20_000, 300_000)
KINDS = ("float64", "float32")


def run(session: Path, kind: str) -> None:
    """Run the session from its folder, or from arrays of a kind; print bytes that were given, and the most held."""
    if kind == "folder":
        given, measured = [], stitch.load_session(session)
    else:
        cell = stitch.load_session(session, scans=False)
        given = [np.load(session / f"{view.name}.{kind}.npy") for view in cell.views]
        poses = [view.T_base_flange for view in cell.views]
        measured = stitch.Session.from_arrays(given, poses, mount=cell.mount, scanner=cell.scanner)
    stitch.run(measured)
    held = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    print(json.dumps({"given": sum(cloud.nbytes for cloud in given), "held": 1024 * int(held[1])}))


def measure(session: Path, kind: str) -> dict[str, int]:
    """What such a run says of itself."""
    command = [sys.executable, __file__, str(session), kind]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])


def panel(folder: Path, points: int) -> Path:
    """The session's folder, with its scans as arrays of every kind beside it."""
    session = folder / f"panel-{VIEWS}-{points}"
    if not session.is_dir():
        write_panel(session, VIEWS, points)
        for view in stitch.load_session(session, at_most=None).views:
            for kind in KINDS:
                np.save(session / f"{view.name}.{kind}.npy", view.cloud.points.astype(kind))
    return session


def main(folder: Path) -> None:
    """Print the table and write it into the page."""
    lines = ["| views × points | arrays of | given, MB | from the folder, MB | from arrays, MB | more, × given |"]
    lines.append("|---|---|---:|---:|---:|---:|")
    for points in POINTS:
        session = panel(folder, points)
        from_folder = measure(session, "folder")["held"]
        for kind in KINDS:
            own = measure(session, kind)
            sizes = (f"{own['given'] / 1e6:.0f}", f"{from_folder / 1e6:.0f}", f"{own['held'] / 1e6:.0f}")
            more = (own["held"] - from_folder) / own["given"]
            lines.append(f"| {VIEWS} × {points:,} | {kind} | {' | '.join(sizes)} | {more:.2f} |")
            print(lines[-1], flush=True)
    into_page("memory", lines, PAGE)


if __name__ == "__main__":
    run(Path(sys.argv[1]), sys.argv[2]) if len(sys.argv) > 2 else main(Path(sys.argv[1]))
