"""The table of formats names every kind of file that is read, and beside it the test that reads one."""

import re
from pathlib import Path

from stitch.intake.found_files import PROGRAMS
from stitch.intake.raw_poses import STRUCTURED, TABLES
from stitch.reading.clouds import CLOUD_SUFFIXES

PAGE = Path(__file__).resolve().parents[2] / "docs" / "own-data.md"
BAGS = (".bag", ".db3", ".mcap")


def rows():
    table = PAGE.read_text(encoding="utf-8").split("## Formats")[1].split("##")[0]
    return [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("|")][2:]


def test_every_kind_of_file_stands_in_the_table():
    named = {ending for row in rows() for ending in re.findall(r"\.[a-z0-9]+\b", row[0])}
    assert {*CLOUD_SUFFIXES, *TABLES, *STRUCTURED, *PROGRAMS, *BAGS} <= named


def test_every_row_has_its_test():
    for row in rows():
        tests = re.findall(r"\]\(([^)]+)\)", row[3])
        assert tests and all((PAGE.parent / test).is_file() for test in tests), row[0]
