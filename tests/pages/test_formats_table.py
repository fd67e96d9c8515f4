"""The table of formats names every kind of file that is read, and beside it the test that reads one."""

import re
from pathlib import Path

from stitch.plugins.intake.raw_poses import PROGRAMS, STRUCTURED, TABLES
from stitch.session.reading.clouds import CLOUD_SUFFIXES

PAGE = Path(__file__).resolve().parents[2] / "docs" / "formats.md"
BAGS = (".bag", ".db3", ".mcap")


def rows():
    table = PAGE.read_text(encoding="utf-8").split("\n| file ")[1]
    return [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")][1:]


def test_every_kind_of_file_stands_in_the_table():
    named = {ending for row in rows() for ending in re.findall(r"\.[a-z0-9]+\b", row[0])}
    assert {*CLOUD_SUFFIXES, *TABLES, *STRUCTURED, *PROGRAMS, *BAGS} <= named


def test_every_row_has_its_tests():
    for row in rows():
        tests = re.findall(r"\[`(\w+)`\]\(([^)]+)\)", row[3])
        assert tests, row[0]
        for name, file in tests:
            text = (PAGE.parent / file).read_text(encoding="utf-8")
            assert re.search(rf"^def {name}\(", text, re.MULTILINE), f"{file} has no {name}"
