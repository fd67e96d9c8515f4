"""The header and the filled lines of a CSV file with their numbers."""

import csv
import re
import shlex
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.session.reading.text_files import not_utf8, require_file, require_name, shortened

# No quantity of a cell is larger in any unit; beyond, squares overflow.
_LARGEST = 1e30
_SEPARATORS = {";": "semicolons", "\t": "tabs"}
_LONGEST_HEADER = 1 << 20
# A quaternion with six digits is unit within 1e-6; beyond 1e-3 something else is written there.
_UNIT_TOLERANCE = 1e-3


class TableRow(dict[str, str]):
    """A row of a table: column -> cell, without blanks around it."""

    def __init__(self, file: Path, line: int, cells: Mapping[str, str]) -> None:
        super().__init__(cells)
        self.file = file
        self.line = line  # its number in the file, from 1

    @property
    def where(self) -> str:
        """File and line, for messages."""
        return f"{self.file} line {self.line}"

    def number(self, column: str, remedy: str = "write a finite number") -> float:
        """Return the number in a column, as `finite_number`."""
        return finite_number(self.file, self.line, column, self[column], remedy)


def read_csv_rows(file: Path) -> tuple[list[str], list[TableRow]]:
    """Return the names of the columns, and all rows that are not empty.

    Raises:
        InputError: the file is not text, is not separated by commas, a quote stays open, or a row has more or fewer
            cells than the header.
    """
    require_file(file, "write the table")
    rows: list[TableRow] = []
    first = 1
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            _require_commas(file, stream.readline(_LONGEST_HEADER))
            stream.seek(0)
            reader = csv.reader(stream, skipinitialspace=True)
            header = [require_name(f"{file} line 1", name.strip(), "column") for name in next(reader, [])]
            first = reader.line_num + 1
            for row in reader:
                if any(cell.strip() for cell in row):
                    _require_cells(file, reader.line_num, row, header)
                    cells = (cell.strip() for cell in row)
                    rows.append(TableRow(file, reader.line_num, dict(zip(header, cells, strict=True))))
                first = reader.line_num + 1
    except UnicodeDecodeError:
        raise InputError(not_utf8(file, "CSV UTF-8")) from None
    except csv.Error as error:
        # A quote that stays open swallows lines until a cell is larger than the csv module allows.
        raise InputError(f"{file} line {first}: {error}; close the quote that opens there") from None
    return header, rows


def require_unit_quaternion(where: str, quaternion: Array) -> float:
    """Return the length of a quaternion (4,), 1 but for the digits that were not written.

    Args:
        where: file and line, for the message.

    Raises:
        InputError: another length: something else than a rotation is written there.
    """
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise InputError(
            f"{where}: qx,qy,qz,qw has length {length:.4f}, not a rotation; write a unit quaternion, w last"
        )
    return length


def _require_commas(file: Path, header: str) -> None:
    """Refuse a table separated by semicolons or tabs, as spreadsheets of many countries write them.

    Args:
        header: its first line, which holds no comma then.

    Raises:
        InputError: names what it is separated by, and how to fix it.
    """
    separator = next((s for s in _SEPARATORS if s in header.strip()), None)
    if separator is None or "," in header:
        return
    cell = rf"(?:^|[{separator}\n])\s*[+-]?\d+,\d+\s*(?=$|[{separator}\r\n])"
    mend = "save it with commas between the cells"
    found = f"is separated by {_SEPARATORS[separator]}"
    if re.search(cell, file.read_text(encoding="utf-8", errors="replace")):
        mend += " and decimal points"
        found += ", with decimal commas"
    if file.name == "views.csv":
        folder = shlex.quote(str(file.parent))
        mend += (
            f", or let `stitch init {folder} --poses {shlex.quote(str(file))} -o OTHER` make a session of it as it is"
        )
    raise InputError(f"{file} line 1: {found}; to fix: {mend}")


def _require_cells(file: Path, line: int, row: list[str], header: list[str]) -> None:
    """Refuse a row of a table that has more or fewer cells than its header; `line` is its number in the file."""
    if len(row) != len(header):
        raise InputError(
            f"{file} line {line}: {len(row)} cells, the header has {len(header)}; to fix: write one cell a column, in "
            "quotes where it holds a comma"
        )


def is_number(cell: str) -> bool:
    """Return True for what Python reads as a number, finite or not."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def finite_number(file: Path, line: int, column: str, cell: str, remedy: str = "write a finite number") -> float:
    """Return the number in a cell, finite and below `_LARGEST`.

    Args:
        line: number of its line in the file, for the message.
        column: name of its column, for the message.
        remedy: how to fix another cell.

    Raises:
        InputError: names file, line and column, and how to fix it.
    """
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not np.abs(value) < _LARGEST:
        raise InputError(f"{file} line {line}: {column} is {shortened(cell.strip())}; {remedy}")
    return value
