"""A formula from some poses of a measured arm, judged on other poses and on another series, with its base and probe.

Run: python bench/explained_arm.py [--write]; writes the table of docs/explain.md. Needs the measured data beside the
project (two series of one UR10, each with a laser tracker somewhere else).
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or ROOT.parent / "shared" / "data")
PAGE = ROOT / "docs" / "explain.md"
MARKS = ("<!-- arm: begin -->", "<!-- arm: end -->")
LEARNT, JUDGED = "ur10-tmac-A", "ur10-tmac-C"
# Of every 60 poses of the first series one is learnt from, and one half-way to the next is judged; of the other, 10.
EVERY, OTHER = 60, 10
STARTS = (0, 7, 14, 21)
GEOMETRY = ("joint_offset", "link_geometry", "joint_compliance")
_COMMAND = "from stitch.cli.main import main; main()"


def stitch(*arguments: object) -> str:
    """What one command prints."""
    told = subprocess.run(
        [sys.executable, "-c", _COMMAND, *map(str, arguments)], capture_output=True, text=True, check=True
    )
    return told.stdout


def some(name: str, start: int, step: int, folder: Path) -> Path:
    """A session of every so many poses of a measured one."""
    folder.mkdir()
    shutil.copy(SHARED / name / "session.toml", folder)
    for table in ("views.csv", "frames.csv"):
        head, *rows = (SHARED / name / table).read_text().splitlines()
        (folder / table).write_text("\n".join([head, *rows[start::step]]) + "\n")
    return folder


def left(session: Path, run: Path, *how: object) -> float:
    """Held-out error of a session, mm."""
    return float(json.loads(stitch("run", session, "-o", run, "--no-recording", "--json", *how))["heldout_rms"])


def rows_of(start: int, folder: Path) -> list[str]:
    """One line: nominal, geometry and compliance, and the formula beside these; on other poses and the other series."""
    learnt = some(LEARNT, start, EVERY, folder / "learnt")
    judged = {
        "other poses": some(LEARNT, start + EVERY // 2, EVERY, folder / "others"),
        "other series": some(JUDGED, start % OTHER, OTHER, folder / "series"),
    }
    stitch("run", learnt, "-o", folder / "r", "--no-recording")
    stitch("add", folder / "r", *GEOMETRY, "--no-recording")
    shutil.copytree(folder / "r", folder / "geometry")
    file = folder / "mine.py"
    found = json.loads(stitch("explain", folder / "r", "--json"))
    if not found["found"]:
        return [f"| {start} | – | – | – | – | none holds |"]
    stitch("explain", folder / "r", "-o", file)
    stitch("add", folder / "r", "explained", "--effects-file", file, "--no-recording")
    out = []
    for name, session in judged.items():
        ways = ([], ["--arm", folder / "geometry"], ["--arm", folder / "r", "--effects-file", file])
        errors = [f"{left(session, folder / f'{session.name}{k}', *how):.3f}" for k, how in enumerate(ways)]
        out.append(f"| {start} | {name} | {' | '.join(errors)} | {found['formula'].replace('|', '∣')} |")
    return out


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--write", action="store_true", help="put the table into docs/explain.md")
    given = parser.parse_args()
    lines = [
        "| learnt from | judged on | nominal arm | geometry and compliance | and the formula | formula |",
        "|---:|---|---:|---:|---:|---|",
    ]
    for start in STARTS:
        with tempfile.TemporaryDirectory() as scratch:
            found = rows_of(start, Path(scratch))
            lines += found
            print(*found, sep="\n", flush=True)
    if given.write:
        text, printed = PAGE.read_text(encoding="utf-8"), "\n".join(lines)
        block = f"{MARKS[0]}\n{printed}\n{MARKS[1]}"
        PAGE.write_text(re.sub(f"{MARKS[0]}.*{MARKS[1]}", lambda _: block, text, flags=re.S), encoding="utf-8")


if __name__ == "__main__":
    main()
