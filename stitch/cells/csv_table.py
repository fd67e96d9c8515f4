"""CSV tables with named columns, as a person edits them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.cells.job_toml import HIGHEST_VALUE
from stitch.errors import InputError
from stitch.frames import Array
from stitch.reading.csv_lines import read_csv_lines
from stitch.reading.csv_number import finite_number


@dataclass(frozen=True)
class CsvColumns:
    """The wanted columns of a CSV file, row by row."""

    texts: dict[str, list[str]]
    numbers: dict[str, Array]  # (N,) each
    rows: int

    def stack(self, names: str) -> Array:
        """Number columns (N, k) by their names, separated by blanks."""
        return np.column_stack([self.numbers[name] for name in names.split()])


def read_columns(file: Path, texts: str, numbers: str) -> CsvColumns:
    """Read a CSV with a header line; other columns are left alone.

    Args:
        texts: names of text columns, separated by blanks.
        numbers: names of number columns, separated by blanks.

    Raises:
        InputError: the file, a column or a value is missing or no finite number; names the line.
    """
    header, lines = read_csv_lines(file)
    for name in (*texts.split(), *numbers.split()):
        if name not in header:
            raise InputError(f"{file}: column {name!r} is missing; the header must name {texts} {numbers}".rstrip())
    if not lines:
        raise InputError(f"{file}: no rows below the header; add one per line")
    rows = [(line, dict(zip(header, cells + [""] * len(header), strict=False))) for line, cells in lines]
    return CsvColumns(
        {name: [_text(file, line, name, row[name]) for line, row in rows] for name in texts.split()},
        {name: np.array([_number(file, line, name, row[name]) for line, row in rows]) for name in numbers.split()},
        len(rows),
    )


def require_unique(file: Path, what: str, names: list[str]) -> None:
    """Refuse a name that stands in two rows.

    Args:
        what: the thing that has the name, such as "hole".

    Raises:
        InputError: names the first that does.
    """
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{file}: {what} {name} stands twice; leave one of them out, or rename it")


def _text(file: Path, line: int, name: str, cell: str) -> str:
    if not cell.strip():
        raise InputError(f"{file} line {line}: {name} is empty; write a name")
    return cell.strip()


def _number(file: Path, line: int, name: str, cell: str) -> float:
    value = finite_number(file, line, name, cell)
    if abs(value) > HIGHEST_VALUE:
        raise InputError(f"{file} line {line}: {name} is {cell.strip()!r}; nothing in a cell is that large")
    return value
