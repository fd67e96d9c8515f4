"""Tables of links of measured arms: fitted for themselves, read back, judged in views that took no part.

Run: python bench/link_tables.py [--write]; writes the table of docs/points.md. Needs the measured data beside the
project.
"""

import argparse
from pathlib import Path

from batch import into_page
from kept_arm import SHARED, every

from stitch.plugins.metrology.calibrate.robot import link_table
from stitch.session.reading.session_folder import load_session

PAGE = Path(__file__).resolve().parents[1] / "docs" / "points.md"
# Every how manieth pose: about 600 of each arm.
SESSIONS = {"irb120-tracker": 1, "ur10-tmac": 1, "ur10-tmac-A": 20, "ur10-tmac-C": 5}


def row_of(name: str, step: int) -> str:
    """One line: what the nominal table leaves, and the fitted one."""
    session = every(load_session(SHARED / name), step)
    found = link_table(session)
    held = " and ".join(found.effects) or "–"
    return f"| {name} | {len(session.views)} | {found.nominal_rms:.3f} | {found.heldout_rms:.3f} | {held} |"


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--write", action="store_true", help="put the table into docs/points.md")
    given = parser.parse_args()
    lines = ["| session | views | nominal table | fitted table | in it |", "|---|---:|---:|---:|---|"]
    lines += [row_of(name, step) for name, step in SESSIONS.items()]
    printed = "\n".join(lines)
    print(printed)
    if given.write:
        into_page("tables", printed.split("\n"), PAGE)


if __name__ == "__main__":
    main()
