"""Rows of a spreadsheet brought to one length: empty cells at the end, titles above, units below the names."""

from collections import Counter

from stitch.intake.table_cells import parse_number, without_trailing_blanks

# Line of the file, and its cells.
NumberedRows = list[tuple[int, list[str]]]
_SEVERAL = 3


def trimmed_rows(rows: NumberedRows) -> NumberedRows:
    """Without empty cells at the end, but for those below a name that only some rows have a remark under."""
    numbered = [cells for _, cells in rows if _number_count(cells) >= _SEVERAL]
    if not numbered:
        return [(line, short) for line, cells in rows if (short := without_trailing_blanks(cells))]
    written = Counter(len(cells) for cells in numbered).most_common(1)[0][0]
    width = max(len(without_trailing_blanks(cells)) for cells in numbered)
    out = []
    for line, cells in rows:
        some = sum(bool(cell) for cell in cells)
        of_table = len(cells) == written and (_number_count(cells) >= _SEVERAL or 2 * some > width)
        short = cells[:width] if of_table else without_trailing_blanks(cells)
        out += [(line, short)] if some else []
    return out


def rows_below_titles(rows: NumberedRows) -> NumberedRows:
    """Without what people write above a table: rows of another length with hardly a number among their words."""
    width = Counter(len(row) for _, row in rows).most_common(1)[0][0] if rows else 0
    first = 0
    while first < len(rows) - 1 and len(rows[first][1]) != width:
        known = [parse_number(cell) is not None for cell in rows[first][1]]
        if all(known) or sum(known) > 1:
            break
        first += 1
    return rows[first:]


def names_with_units(names: list[str], cells: list[str]) -> list[str] | None:
    """Names with the units that stand in a row of their own below them; None where that row is none of units."""
    if len(cells) > len(names) or _number_count(cells):
        return None
    below = [*cells, *[""] * (len(names) - len(cells))]
    return [f"{name} [{cell.strip('[]() ')}]" if cell else name for name, cell in zip(names, below, strict=True)]


def _number_count(cells: list[str]) -> int:
    return sum(parse_number(cell) is not None for cell in cells)
