"""CSV tables with named columns, as a person edits them."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.cells.toml_tables import LARGEST
from stitch.errors import InputError
from stitch.frames import Array


@dataclass(frozen=True)
class Columns:
    """The wanted columns of a CSV file, row by row."""

    texts: dict[str, list[str]]
    numbers: dict[str, Array]  # (N,) each
    rows: int

    def stack(self, names: str) -> Array:
        """Number columns (N, k) by their names, separated by blanks."""
        return np.column_stack([self.numbers[name] for name in names.split()])


def read_columns(file: Path, texts: str, numbers: str) -> Columns:
    """Read a CSV with a header line; other columns are left alone.

    Args:
        texts: names of text columns, separated by blanks.
        numbers: names of number columns, separated by blanks.

    Raises:
        InputError: the file, a column or a value is missing or no finite number; names the line.
    """
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream, skipinitialspace=True)
            rows = [(reader.line_num, row) for row in reader]
            header = [name.strip() for name in reader.fieldnames or []]
    except FileNotFoundError:
        raise InputError(f"{file}: not found; write it, or mend its name in the job file") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file}: not a CSV file in UTF-8: {error}") from None
    for name in (*texts.split(), *numbers.split()):
        if name not in header:
            raise InputError(f"{file}: column {name!r} is missing; the header must name {texts} {numbers}".rstrip())
    if not rows:
        raise InputError(f"{file}: no rows below the header; add one per line")
    clean = [(line, {(key or "").strip(): value for key, value in row.items()}) for line, row in rows]
    return Columns(
        {name: [_text(file, line, name, row.get(name)) for line, row in clean] for name in texts.split()},
        {name: np.array([_number(file, line, name, row.get(name)) for line, row in clean]) for name in numbers.split()},
        len(clean),
    )


def _text(file: Path, line: int, name: str, value: str | None) -> str:
    if not (value or "").strip():
        raise InputError(f"{file}:{line}: {name} is empty; write a name")
    return str(value).strip()


def _number(file: Path, line: int, name: str, value: str | None) -> float:
    try:
        number = float(value or "")
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or abs(number) > LARGEST:
        raise InputError(f"{file}:{line}: {name} is {value!r}; write a finite number")
    return number
