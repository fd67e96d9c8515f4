"""Cells of a table as people write them, and the numbers in them."""

import csv
import re

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
# A pose as Universal Robots writes it: p[0.1, 0.2, …].
_POSE_OF_UR = re.compile(r"(?<!\w)p\s*\[(?=\s*[+-]?\.?\d)")
_BRACKETS = str.maketrans("[](){}", " " * 6)


def split_cells(line: str, separator: str) -> list[str]:
    """Cells of a line, trimmed."""
    line = _POSE_OF_UR.sub("[", line).translate(_BRACKETS).strip()
    if separator == " ":
        return line.split()
    row = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return [cell.strip().strip('"') for cell in row]


def parse_number(cell: str) -> float | None:
    """The number in a cell, with a point or a comma; None if there is none."""
    cell = cell.rstrip("°").strip()
    if _NUMBER.fullmatch(cell):
        return float(cell)
    if DECIMAL_COMMA.fullmatch(cell):
        return float(cell.replace(",", "."))
    return None


def without_trailing_blanks(cells: list[str]) -> list[str]:
    """Cells without the empty ones at the end."""
    last = max((i for i, cell in enumerate(cells) if cell), default=-1)
    return cells[: last + 1]
