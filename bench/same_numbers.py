"""Do two states of the code compute the same? python bench/same_numbers.py make OUT, then … compare BEFORE AFTER.

`make` runs the demo, one real object from nothing, an arm measured by laser tracker and a cell with clouds and points
through run, compare, diagnose and add; `compare` prints the largest relative difference of every document.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
# What differs from run to run, and where a session lies.
_SKIPPED = {"seconds", "versions", "session"}
_ADDED = ("joint_offset", "joint_compliance", "settling", "link_geometry")


def stitch(folder: Path, *arguments: str) -> None:
    """One command in a folder, on one thread."""
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    code = "from stitch.cli.main import main; main()"
    print("stitch", *arguments, file=sys.stderr)
    subprocess.run([sys.executable, "-c", code, *arguments], cwd=folder, env=os.environ | one, check=False)


def make(out: Path) -> None:
    """All cases; those without their measured data are left out."""
    out.mkdir(parents=True)
    stitch(out, "demo", "runs/demo")
    stitch(out, "synth", "spheres", "spheres", "--hide", "joint_offset=1", "--seed", "5")
    stitch(out, "synth", "drill-plate", "plate", "--hide", "joint_compliance=2", "--seed", "6")
    cases = {"david": SHARED / "reghec" / "david", "irb120": SHARED / "irb120-tracker"}
    cases |= {"spheres": out / "spheres", "plate": out / "plate"}
    for name, session in cases.items():
        if not session.is_dir():
            continue
        run = f"runs/{name}"
        stitch(out, "run", str(session), "-o", run, "--no-recording")
        stitch(out, "compare", run)
        stitch(out, "diagnose", run)
        (out / run / "diagnosis.json").rename(out / run / "diagnosis-first.json")
        if name != "david":
            stitch(out, "add", run, *(_ADDED if name == "irb120" else _ADDED[1:2]), "--no-recording")
            stitch(out, "diagnose", run)


def differences(a: Any, b: Any, path: str = "") -> Iterator[tuple[float, str]]:
    """Relative difference of every number or list of numbers, and 1 for what is not there or other words."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in sorted((set(a) | set(b)) - _SKIPPED):
            if key in a and key in b:
                yield from differences(a[key], b[key], f"{path}.{key}")
            else:
                yield 1.0, f"{path}.{key} is only in one"
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        if a and all(isinstance(x, (int, float)) for x in a + b):
            yield max(abs(x - y) for x, y in zip(a, b, strict=True)) / max(*map(abs, a), 1e-12), path
        else:
            for i, (x, y) in enumerate(zip(a, b, strict=True)):
                yield from differences(x, y, f"{path}[{i}]")
    elif isinstance(a, (int, float)) and isinstance(b, (int, float)):
        yield abs(a - b) / max(abs(a), 1e-12), path
    elif a != b:
        yield 1.0, f"{path}: {str(a)[:60]!r} and {str(b)[:60]!r}"


def compare(before: Path, after: Path) -> None:
    """A row a document: numbers, largest relative difference and where."""
    print("| document | numbers | largest relative difference | where |\n|---|---|---|---|")
    for file in sorted(before.glob("runs/**/*.json")):
        other = after / file.relative_to(before)
        if not other.is_file():
            print(f"| {file.relative_to(before)} | – | missing | |")
            continue
        found = list(differences(json.loads(file.read_text()), json.loads(other.read_text())))
        worst, where = max(found, default=(0.0, ""))
        print(f"| {file.relative_to(before / 'runs')} | {len(found)} | {worst:.1e} | {where if worst else ''} |")


def main() -> None:
    """Make the cases, or compare two sets of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make", "compare"))
    parser.add_argument("folders", type=Path, nargs="+")
    given = parser.parse_args()
    if given.what == "make":
        make(given.folders[0].resolve())
    else:
        compare(*given.folders)


if __name__ == "__main__":
    main()
