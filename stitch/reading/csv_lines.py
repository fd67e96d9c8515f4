"""The header and the filled lines of a CSV file with their numbers."""

import csv
from pathlib import Path

from stitch.errors import InputError


def read_lines(file: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Names of the columns, and line number and cells of every line that is not empty.

    Raises:
        InputError: the file is not text.
    """
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream, skipinitialspace=True)
            header = [name.strip() for name in next(reader, [])]
            return header, [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: not UTF-8 text ({error.reason}); save it as CSV") from None
