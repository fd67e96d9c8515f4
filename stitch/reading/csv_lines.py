"""The header and the filled lines of a CSV file with their numbers."""

import csv
from pathlib import Path

from stitch.errors import InputError
from stitch.reading.names import require_name
from stitch.reading.separators import require_commas
from stitch.reading.text_file import not_utf8, require_file

_LONGEST_HEADER = 1 << 20


def read_csv_lines(file: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Names of the columns, and line number and cells of every line that is not empty.

    Raises:
        InputError: the file is not text, is not separated by commas, a quote stays open, or a row has more or fewer
            cells than the header.
    """
    require_file(file, "write the table")
    rows: list[tuple[int, list[str]]] = []
    first = 1
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            require_commas(file, stream.readline(_LONGEST_HEADER))
            stream.seek(0)
            reader = csv.reader(stream, skipinitialspace=True)
            header = [require_name(f"{file} line 1", name.strip(), "column") for name in next(reader, [])]
            first = reader.line_num + 1
            for row in reader:
                if any(cell.strip() for cell in row):
                    _require_cells(file, reader.line_num, row, header)
                    rows.append((reader.line_num, row))
                first = reader.line_num + 1
    except UnicodeDecodeError:
        raise InputError(not_utf8(file, "CSV UTF-8")) from None
    except csv.Error as error:
        # A quote that stays open swallows lines until a cell is larger than the csv module allows.
        raise InputError(f"{file} line {first}: {error}; close the quote that opens there") from None
    return header, rows


def _require_cells(file: Path, line: int, row: list[str], header: list[str]) -> None:
    if len(row) != len(header):
        raise InputError(
            f"{file} line {line}: {len(row)} cells, the header has {len(header)}; to fix: write one cell a column, in "
            "quotes where it holds a comma"
        )
