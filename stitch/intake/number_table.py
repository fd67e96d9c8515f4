"""Plain tables of numbers as people write them: any separator, decimal commas, with a header or none."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.table_cells import DECIMAL_COMMA, parse_number, split_cells
from stitch.intake.table_rows import names_with_units, rows_below_titles, trimmed_rows
from stitch.reading.text_file import read_any_text, shortened

_SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas", " ": "spaces"}
_COMMENTS = ("#", "%", "//")
_MAX_TABLE_MB = 50


@dataclass(frozen=True)
class NumberTable:
    """Numbers in rows, as one file has them."""

    file: Path
    header: tuple[str, ...] | None  # names of the columns of numbers
    numbers: Array  # (n, C)
    labels: tuple[tuple[str, ...], ...]  # texts of every row, from columns that hold no numbers
    lines: tuple[int, ...]  # line number of every row
    words: str  # how it was read


def read_number_table(file: Path) -> NumberTable:
    """Read a table of numbers.

    Raises:
        InputError: no numbers in rows, rows of different length, or a cell without a number; names the line.
    """
    return parse_number_table(file, read_any_text(file, "name a table of poses", _MAX_TABLE_MB))


def parse_number_table(file: Path, content: str) -> NumberTable:
    """The same of a text that was read from a file."""
    kept = [(i, line.strip()) for i, line in enumerate(content.splitlines(), 1) if line.strip()]
    body = [(i, line) for i, line in kept if not line.startswith(_COMMENTS)]
    if not body:
        raise InputError(f"{file}: holds no rows of numbers; to fix: name the table of poses")
    separator = max(
        _SEPARATORS, key=lambda s: sum(parse_number(c) is not None for _, line in body for c in split_cells(line, s))
    )
    read = trimmed_rows([(i, split_cells(line, separator)) for i, line in body])
    rows = rows_below_titles(read)
    above = len(read) - len(rows)
    comments = [(i, line) for i, line in kept if line.startswith(_COMMENTS) and i < body[0][0]]
    header, rows = _split_header(file, rows, comments[-1][1] if comments else "", separator)
    text, numeric = _text_and_number_columns(rows)
    if len(numeric) < 3:
        raise InputError(f"{file}: holds no rows of numbers; to fix: name the table of poses")
    numbers = np.array([[_cell_number(file, i, row[c]) for c in numeric] for i, row in rows])
    _require_one_decimal_mark(file, rows, numeric)
    decimal = any(DECIMAL_COMMA.fullmatch(row[c]) for _, row in rows for c in numeric)
    words = f"separated by {_SEPARATORS[separator]}{', decimal commas' * decimal}"
    words += ", with a header" if header else ", without a header"
    if above:
        words += f", {above} line{'s' * (above > 1)} of words above it passed over"
    return NumberTable(
        file=file,
        header=tuple(header[c] for c in numeric) if header else None,
        numbers=numbers,
        labels=tuple(tuple(row[c] for c in text) for _, row in rows),
        lines=tuple(i for i, _ in rows),
        words=words,
    )


def _cell_number(file: Path, line: int, cell: str) -> float:
    found = parse_number(cell)
    if found is None or not abs(found) < 1e30:
        raise InputError(f"{file} line {line}: {shortened(cell)} is no number; to fix: write one there")
    return found


def _require_one_decimal_mark(file: Path, rows: Sequence[tuple[int, list[str]]], numeric: Sequence[int]) -> None:
    """Refuse a column with commas before the decimals in which a point stands too: 1.269 may mean a thousand."""
    for c in numeric:
        pointed = [(i, row[c]) for i, row in rows if "." in row[c]]
        if pointed and any("," in row[c] for _, row in rows):
            line, cell = pointed[0]
            raise InputError(
                f"{file} line {line}: {shortened(cell)} has a point, other numbers of its column have a comma before "
                "their decimals; to fix: write all alike, without marks for thousands"
            )


def _split_header(
    file: Path, rows: list[tuple[int, list[str]]], comment: str, separator: str
) -> tuple[list[str] | None, list[tuple[int, list[str]]]]:
    """The header's names, from the first row or the comment above it, and the rows of numbers, all of one length."""
    header: list[str] | None = None
    if not rows:
        raise InputError(f"{file}: holds no rows of numbers; to fix: name the table of poses")
    top, first = rows[0]
    below = rows[1:] or rows
    width = Counter(len(row) for _, row in [*below, rows[0]]).most_common(1)[0][0]
    typical = next(
        (row for _, row in below if len(row) == width and any(parse_number(c) is not None for c in row)), first
    )
    texts = [parse_number(cell) is None for cell in first]
    if len(rows) > 1 and any(t and parse_number(c) is not None for t, c in zip(texts, typical, strict=False)):
        header, rows = first, rows[1:]
        units = names_with_units(header, rows[0][1]) if len(rows) > 1 else None
        if units is not None:
            header, rows = units, rows[1:]
    elif comment:
        names = split_cells(comment.lstrip("#%/ "), separator)
        header = names if len(names) == width and all(parse_number(name) is None for name in names) else None
    odd = next(((i, row) for i, row in rows if len(row) != width), None)
    if odd is not None:
        raise InputError(
            f"{file} line {odd[0]}: {len(odd[1])} cells, other rows have {width}; to fix: write one number a column"
        )
    if header is not None and len(header) != width:
        raise InputError(f"{file} line {top}: {len(header)} names for {width} columns; to fix: name every column once")
    return header, rows


def _text_and_number_columns(rows: Sequence[tuple[int, list[str]]]) -> tuple[list[int], list[int]]:
    """Columns of text, and of numbers: a column with numbers in more than half of its cells is one of numbers."""
    width = len(rows[0][1])
    share = [sum(parse_number(row[c]) is not None for _, row in rows) / len(rows) for c in range(width)]
    return [c for c in range(width) if share[c] <= 0.5], [c for c in range(width) if share[c] > 0.5]
