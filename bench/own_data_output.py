"""Run the example of docs/own-data.md and write what it prints: python -m bench.own_data_output.

The folder is made as people have theirs: scans, and a table of poses without a header.
"""

import tempfile
from pathlib import Path

from bench.readme_output import BEGIN, END, commands, printed, shown
from data_synth.commands import synth
from data_synth.fixtures.raw_folders import Convention, raw_folder

PAGE = Path(__file__).resolve().parents[1] / "docs" / "own-data.md"


def prepare(folder: Path) -> None:
    """Scans of a blade whose scanner measures too long, and a robot's poses in degrees, in `folder`/scans."""
    cell = folder / "cell"
    synth("blade-table", cell, hide=["range_scale=3"], views=8, seed=3)
    raw_folder(cell, folder / "scans", Convention("ZYX", degrees=True, angles_first=False), "robot_poses.txt")


def main() -> None:
    """Write the example into the page."""
    example = shown(PAGE)
    with tempfile.TemporaryDirectory() as folder:
        prepare(Path(folder))
        anew = printed(commands(example), Path(folder))
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text.replace(BEGIN + example + END, BEGIN + anew + END), encoding="utf-8")


if __name__ == "__main__":
    main()
