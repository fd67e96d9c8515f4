"""Plain tables of numbers as people write them: any separator, decimal commas, with a header or none."""

import csv
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from stitch.numerics.frames import Array
from stitch.plugins.intake.clock_times import is_time_of_day
from stitch.plugins.intake.column_names import bare_name, is_unit
from stitch.plugins.intake.refusals import Fix, Refusal, change
from stitch.session.reading.text_files import shortened

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?")
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
# A pose as Universal Robots writes it: p[0.1, 0.2, …].
_POSE_OF_UR = re.compile(r"(?<!\w)p\s*\[(?=\s*[+-]?\.?\d)")
# What programs write where they have no number.
_MARKED_NUMBER = re.compile(r"^#\d+\b(?=\s*[(\[])")
_GROUPS = re.compile(r"[)\]]\s*[(\[]")
_NO_NUMBER = re.compile(r"[+-]?(nan|inf(inity)?)|null|none|#?n/?a|-?1\.#(qnan|ind|inf)", re.IGNORECASE)
# A number behind a name, "pose 0: 0.83" or "P0 0.83", and before a name or a unit, "0.83 a.ply" or "0.83 mm".
_DECIMAL = r"[+-]?\d*[.,]\d+(?:[eE][+-]?\d+)?"
_NUMBER_BEHIND = re.compile(rf"(.*\S\s*[:=])\s+([+-]?\d[\d.,]*(?:[eE][+-]?\d+)?)|(.*[A-Za-z_].*?[:=\s])\s*({_DECIMAL})")
_NUMBER_BEFORE = re.compile(rf"({_DECIMAL})\s*([A-Za-z°].*)")
_BRACKETS = str.maketrans("[](){}", " " * 6)
# Rows of a matrix as MATLAB has them: "T1 = [0.36, 0.93, 0.1; 0.2, …];".
_ROWS = re.compile(r"\[[^\[\]]*\d\.\d[^\[\]]*;[^\[\]]*\]")
# Line of the file, and its cells.
NumberedRows = list[tuple[int, list[str]]]
_SEVERAL = 3
_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars", ",": "commas", " ": "spaces"}
# Lines that are drawn, as below the header of a table in Markdown.
_RULE = re.compile(r"[-|:+=\s]*(?:-{3}|={3})[-|:+=\s]*")
# Between cells, whatever the separator; a row of a pose has so many at least.
_CELL_END = re.compile(r"\s*[;,=|\t]\s*|\s+")
_FEWEST_CELLS = 6
# Lines that tell the separator.
_SAMPLED = 2000
# Longer lines are of drawings and documents.
_LONGEST_LINE = 100_000
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:(?:\.\d{3})+,\d+|(?:,\d{3})+\.\d+|(?:['’ \u202f\xa0\u2009]\d{3})+[.,]\d+)")
_COMMENTS = ("#", "%", "//")
# A row of names that stand over several columns has more empty cells than this leaves.
_SPARSE = 0.6
_COORDINATES = {*"xyz", "rx", "ry", "rz", "rotx", "roty", "rotz", "qx", "qy", "qz", "qw", "roll", "pitch", "yaw"}


def split_cells(line: str, separator: str) -> list[str]:
    """Cells of a line, trimmed."""
    if ";" in line and _ROWS.search(line):
        line = _ROWS.sub(lambda rows: re.sub("[,;] *", separator, rows[0]), line.rstrip("; "))
    # "#1 (x, y, z) (q…)": a row's number, and groups of numbers.
    line = _GROUPS.sub(separator, _MARKED_NUMBER.sub(lambda mark: mark[0] + separator, line))
    line = _POSE_OF_UR.sub("[", line).translate(_BRACKETS).strip()
    if separator == " ":
        return line.rstrip(";,").split()
    row = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return [cell.strip().strip('"') for cell in row]


@lru_cache(maxsize=1 << 17)
def parse_number(cell: str) -> float | None:
    """Return the number in a cell, with a point or a comma, NaN for what programs write for none; None of words."""
    cell = cell.rstrip("°").strip()
    if _NO_NUMBER.fullmatch(cell):
        return float("nan")
    if _NUMBER.fullmatch(cell):
        return float(re.sub("[dD]", "e", cell))
    if DECIMAL_COMMA.fullmatch(cell):
        return float(cell.replace(",", "."))
    return None


def _without_trailing_blanks(cells: list[str]) -> list[str]:
    """Cells without the empty ones at the end."""
    last = max((i for i, cell in enumerate(cells) if cell), default=-1)
    return cells[: last + 1]


def _trimmed_rows(rows: NumberedRows) -> NumberedRows:
    """Without empty cells at the end, but for those below a name that only some rows have a remark under."""
    numbered = [cells for _, cells in rows if _number_count(cells) >= _SEVERAL]
    if not numbered:
        return [(line, short) for line, cells in rows if (short := _without_trailing_blanks(cells))]
    written = Counter(len(cells) for cells in numbered).most_common(1)[0][0]
    width = max(len(_without_trailing_blanks(cells)) for cells in numbered)
    first, *_, last = [line for line, cells in rows if _number_count(cells) >= _SEVERAL] * 2
    out = []
    for line, cells in rows:
        some = sum(bool(cell) for cell in cells)
        # Between rows of numbers, a name alone is a view without a pose; elsewhere it is a title or a remark.
        named = _number_count(cells) >= _SEVERAL or 2 * some > width or first < line < last
        of_table = len(cells) == written and named
        short = cells[:width] if of_table else _without_trailing_blanks(cells)
        out += [(line, short)] if some else []
    return out


def _number_count(cells: list[str]) -> int:
    return sum(parse_number(cell) is not None for cell in cells)


@dataclass(frozen=True)
class NumberTable:
    """Numbers in rows, as one file has them."""

    file: Path
    header: tuple[str, ...] | None  # names of the columns of numbers
    numbers: Array  # (n, C); NaN where a program wrote that it had none
    labels: tuple[tuple[str, ...], ...]  # texts of every row, from columns that hold no numbers
    lines: tuple[int, ...]  # line number of every row
    words: str  # how it was read


def parse_number_table(file: Path, content: str, *, sparse: bool = False) -> NumberTable:
    """Read a table of numbers from the text of a file.

    Args:
        sparse: a row may lack some of its numbers, which are NaN; else it is refused.

    Raises:
        InputError: no numbers in rows, rows of different length, or a cell without a number; names the line.
    """
    lines = [(i, line.strip()) for i, line in enumerate(content.replace("\u2212", "-").splitlines(), 1)]
    kept = [(i, line) for i, line in lines if line and not _RULE.fullmatch(line)]
    body = [(i, line) for i, line in kept if not line.startswith(_COMMENTS)]
    # Where every line is marked, #1 is a row's number.
    body = body or [(i, line) for i, line in kept if _MARKED_NUMBER.match(line)]
    if not body or max(len(line) for _, line in body) > _LONGEST_LINE:
        raise _no_rows(file)
    separator = _separator_of([line for _, line in body[:_SAMPLED]])
    cells = {i: split_cells(line, separator) for i, line in body}
    rows = _trimmed_rows(list(cells.items()))
    comments = [line.lstrip("#%/ ") for i, line in kept if line.startswith(_COMMENTS) and i < body[0][0]]
    comment = split_cells(comments[-1], separator) if comments else []
    header, above, rows = _split_head(file, rows, cells, comment)
    header, rows = _split_labels(header, rows)
    text, numeric = _text_and_number_columns(rows)
    cut = _is_cut_short(content, [row[numeric[-1]] for _, row in rows] if numeric else [])
    rows = rows[:-1] if cut else rows
    if len(numeric) < (1 if header else _SEVERAL):
        raise _no_rows(file)
    numbers = np.array(
        [
            [_cell_number(file, i, row[c] or "nan" * (sparse or not any(row[k] for k in numeric))) for c in numeric]
            for i, row in rows
        ]
    )
    _require_one_decimal_mark(file, rows, numeric)
    _require_numbers(file, header, rows, text)
    decimal = any(DECIMAL_COMMA.fullmatch(row[c]) for _, row in rows for c in numeric)
    words = f"separated by {_SEPARATORS[separator]}{', decimal commas' * decimal}"
    words += ", with a header" if header else ", without a header"
    words += ", the last row is cut short and left out" * cut
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


def longest_block(content: str) -> tuple[str, str] | None:
    """Return the longest run of rows of numbers with the names above it, other lines blank, and what was left out.

    None where another row of numbers stands outside it: a file of such rows is a table with a mistake in it. A last row
    that is cut short is left out.
    """
    lines = content.splitlines() or [""]
    cells = [[] if line.strip().startswith(_COMMENTS) else _CELL_END.split(line.strip()) for line in lines]
    counts = [_number_count(row) for row in cells]
    edges = [0, *(i for i in range(1, len(lines)) if counts[i] != counts[i - 1]), len(lines)]
    runs = [(end - first, first) for first, end in pairwise(edges) if counts[first] >= _FEWEST_CELLS]
    length, first = max(runs, default=(0, 0))
    outside = [i for i, n in enumerate(counts) if n >= _SEVERAL and not first <= i < first + length]
    short = outside == [first + length] and not any(map(str.strip, lines[first + length + 1 :]))
    if length < _SEVERAL or (outside and not short):
        return None
    named = first > 0 and counts[first - 1] == 0 and len(cells[first - 1]) >= _FEWEST_CELLS
    kept = range(first - named, first + length)
    words = f"line {first + length + 1} is cut short and left out" if short else "lines of words passed over"
    return "\n".join(line if i in kept else "" for i, line in enumerate(lines)), words


def repeated_records(content: str) -> list[list[str]]:
    """Return the longest run of lines of as many numbers each, for records that go over several lines; few are none."""
    cells = [_CELL_END.split(line.strip()) for line in content.splitlines() if line.strip()]
    widths = [len(row) if all(parse_number(cell) is not None for cell in row) else 0 for row in cells]
    edges = [0, *(i for i in range(1, len(cells)) if widths[i] != widths[i - 1]), len(cells)]
    runs = pairwise(edges) if cells else ()
    first, end = max(runs, key=lambda run: (run[1] - run[0]) * (widths[run[0]] > 1), default=(0, 0))
    return cells[first:end] if first < end and widths[first] > 1 else []


def _no_rows(file: Path) -> Refusal:
    named = Fix("name the table of poses with --poses FILE", {"poses": "FILE"})
    return Refusal(f"{file}: holds no rows of numbers", named)


def _cell_number(file: Path, line: int, cell: str) -> float:
    found = parse_number(cell)
    if _THOUSANDS.fullmatch(cell):
        raise _has_marks(file, line, cell)
    if found is None or abs(found) >= 1e30:
        raise Refusal(f"{file} line {line}: {shortened(cell)} is no number", change(file, "write one there"))
    return found


def _require_one_decimal_mark(file: Path, rows: Sequence[tuple[int, list[str]]], numeric: Sequence[int]) -> None:
    """Refuse a column with commas before the decimals in which a point stands too: 1.269 may mean a thousand."""
    for c in numeric:
        pointed = [(i, row[c]) for i, row in rows if "." in row[c]]
        if pointed and any("," in row[c] for _, row in rows):
            line, cell = pointed[0]
            raise Refusal(
                f"{file} line {line}: {shortened(cell)} has a point, other numbers of its column have a comma before "
                "their decimals",
                change(file, "write all alike, without marks for thousands"),
            )


def _is_cut_short(content: str, cells: Sequence[str]) -> bool:
    """Whether a text ends within its last number, which has fewer decimals than all others of its column."""
    decimals = [len(re.split("[.,]", cell)[-1]) if re.search("[.,]", cell) else 0 for cell in cells]
    return len(cells) > _SEVERAL and content[-1:].isdigit() and decimals[-1] < min(decimals[:-1]) == max(decimals[:-1])


def _require_numbers(file: Path, header: list[str] | None, rows: NumberedRows, text: Sequence[int]) -> None:
    """Refuse marks for thousands, and what begins with digits under the name of a coordinate: they make it words."""
    for c in text:
        name = header[c] if header else ""
        for line, row in rows:
            if _THOUSANDS.fullmatch(row[c]):
                raise _has_marks(file, line, row[c])
        if bare_name(name)[0] in _COORDINATES and any(re.match(r"[+-]?\d", row[c]) for _, row in rows):
            line, cell = next((line, row[c]) for line, row in rows if parse_number(row[c]) is None)
            told = f"{file} line {line}: {shortened(cell)} in column {name} is no number"
            raise Refusal(told, change(file, "write numbers there"))


def _has_marks(file: Path, line: int, cell: str) -> Refusal:
    told = f"{file} line {line}: {shortened(cell)} has marks for thousands"
    return Refusal(told, change(file, "write the numbers without them"))


def _split_head(
    file: Path, rows: NumberedRows, cells: Mapping[int, list[str]], comment: list[str]
) -> tuple[list[str] | None, int, NumberedRows]:
    """Return the names of the columns, how many lines of words stand above, and the rows of numbers, all of one length.

    Args:
        rows: trimmed.
        cells: by line, as written.
        comment: cells of the comment above the table, which may name its columns.
    """
    width = Counter(len(row) for _, row in rows[1:] + rows[:1]).most_common(1)[0][0]
    typical = max((row for _, row in rows[1:_SAMPLED] + rows[:1] if len(row) == width), key=_number_count)
    heads, first = list[list[str]](), 0
    while first < len(rows) - 1:
        line, row = rows[first]
        written, count = [*cells[line], ""][:width], _number_count(row)
        named = any(parse_number(c) is None and parse_number(t) is not None for c, t in zip(row, typical, strict=False))
        # A number alone is a count, or a rate.
        words = 2 * count <= sum(map(bool, row)) or len(row) == 1
        # Numbers between words, as of markers, are none of the table.
        between = _number_count(rows[first + 1][1]) == 0 and len(rows[first + 1][1]) == width
        if not words if len(row) != width else not named or (heads and count and not between):
            break
        if len(written) == width and abs(len(cells[line]) - width) < 2 and sum(map(bool, written)) > 1 >= count:
            heads.append(written)
        first += 1
    if odd := next(((i, row) for i, row in rows[first:] if len(row) != width), None):
        told = f"{file} line {odd[0]}: {len(odd[1])} cells, other rows have {width}"
        raise Refusal(told, change(file, "write one number a column"))
    if not heads:
        header = comment if len(comment) == width and not _number_count(comment) else None
        return header, first, rows[first:]
    units = heads.pop() if len(heads) > 1 and all(is_unit(cell) for cell in heads[-1] if cell) else [""] * width
    above = first - len(heads) - any(units)
    header = [_merged_name(heads, c) for c in range(width)]
    header = [f"{name} [{unit.strip('[]() ')}]" if unit else name for name, unit in zip(header, units, strict=True)]
    return header, above, rows[first:]


def _merged_name(heads: list[list[str]], column: int) -> str:
    """What stands above a column, one below the other; a name that stands over several columns counts for each."""
    words = []
    for row in heads:
        name = row[column]
        if not name and column > 1 and row is not heads[-1] and sum(map(bool, row)) < _SPARSE * len(row):
            name = next((cell for cell in row[column:1:-1] if cell), "")
        words += [name] * bool(name)
    return " ".join(dict.fromkeys(words if column > 1 else words[-1:]))


def _split_labels(header: list[str] | None, rows: NumberedRows) -> tuple[list[str] | None, NumberedRows]:
    """Part numbers from the words in their cells, so that none is lost; a unit behind them goes into the name."""
    for c in range(len(rows[0][1]) - 1, -1, -1):
        parts = [_label_and_number(row[c]) for _, row in rows]
        known = [part for part in parts if part is not None]
        if 2 * len(known) <= len(rows):
            continue
        behind = {words for words, _ in known}
        rows = [
            (i, [*row[:c], *(part or (row[c], "nan")), *row[c + 1 :]])
            for (i, row), part in zip(rows, parts, strict=True)
        ]
        if header is not None:
            unit = f"{header[c]} [{behind.pop()}]" if len(behind) == 1 else header[c]
            header = [*header[:c], "", unit, *header[c + 1 :]]
    return header, rows


def _label_and_number(cell: str) -> tuple[str, str] | None:
    if parse_number(cell) is not None or is_time_of_day(cell):
        return None
    if found := _NUMBER_BEHIND.fullmatch(cell):
        return (found[1] or found[3]).rstrip(" :="), found[2] or found[4]
    found = _NUMBER_BEFORE.fullmatch(cell)
    return None if found is None else (found[2], found[1])


def _text_and_number_columns(rows: Sequence[tuple[int, list[str]]]) -> tuple[list[int], list[int]]:
    """Columns of text, and of numbers: a column with numbers in more than half of its cells is one of numbers."""
    width = len(rows[0][1])
    share = [sum(parse_number(row[c]) is not None for _, row in rows) / len(rows) for c in range(width)]
    return [c for c in range(width) if share[c] <= 0.5], [c for c in range(width) if share[c] > 0.5]


def _separator_of(lines: Sequence[str]) -> str:
    cells = {s: [split_cells(line, s) for line in lines] for s in _SEPARATORS}
    counts = {s: [_number_count(row) for row in cells[s]] for s in _SEPARATORS}
    if max(map(max, counts.values())) < _SEVERAL:  # "0.83 mm" in each cell
        labelled = {s: [sum(_label_and_number(c) is not None for c in row) for row in cells[s]] for s in _SEPARATORS}
        counts = labelled if max(map(max, labelled.values())) >= _SEVERAL else counts
    # A number in the words above a table is none of its cells.
    least = _SEVERAL if max(map(max, counts.values())) >= _SEVERAL else 1
    return max(counts, key=lambda s: sum(n for n in counts[s] if n >= least))
