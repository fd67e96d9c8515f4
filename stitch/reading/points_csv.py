"""points.csv and targets.csv: points that a sensor knows by name, and where a drawing puts them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.measurement.labelled_points import NominalTargets, Sighting
from stitch.reading.csv_lines import read_csv_lines
from stitch.reading.csv_number import finite_number
from stitch.reading.names import require_name
from stitch.reading.text_file import shortened

_XYZ = ("x", "y", "z")


def read_points(file: Path, known: Sequence[str]) -> dict[str, Sighting]:
    """Read and check points.csv: the sighting of every view that has one.

    Args:
        known: views of views.csv.

    Raises:
        InputError: names the line and how to fix it.
    """
    allowed = set(known)
    rows: dict[str, list[tuple[str, list[float]]]] = {}
    seen: dict[tuple[str, str], int] = {}
    for line, row in _table_rows(file, ("view", "target", *_XYZ)):
        view, target = row["view"], row["target"]
        if view not in allowed:
            raise InputError(
                f"{file} line {line}: view {shortened(view)} is not in views.csv; add it there or remove the row"
            )
        if (view, target) in seen:
            raise InputError(
                f"{file} line {line}: view {view} shows target {target} on line {seen[view, target]} already; "
                "leave one out, or name it otherwise"
            )
        seen[view, target] = line
        rows.setdefault(view, []).append((target, _point_numbers(file, line, row)))
    table = {view: np.array([numbers for _, numbers in found]) for view, found in rows.items()}
    return {
        view: Sighting(tuple(name for name, _ in found), table[view][:, :3], table[view][:, 3])
        for view, found in rows.items()
    }


def read_targets(file: Path, sighted: Sequence[str]) -> NominalTargets:
    """Read and check targets.csv.

    Args:
        sighted: targets of points.csv; one of them at least must be here.

    Raises:
        InputError: names the line and how to fix it.
    """
    lines: dict[str, int] = {}
    table = []
    for line, row in _table_rows(file, ("target", *_XYZ)):
        name = row["target"]
        if name in lines:
            raise InputError(f"{file} line {line}: target {name} stands on line {lines[name]} already; leave one out")
        lines[name] = line
        table.append(_point_numbers(file, line, row))
    if not set(lines) & set(sighted):
        raise InputError(
            f"{file}: none of its targets ({', '.join(list(lines)[:4])}) is seen in points.csv "
            f"({', '.join(list(sighted)[:4])}); use the same names, or remove the file"
        )
    numbers = np.array(table)
    return NominalTargets(tuple(lines), numbers[:, :3], numbers[:, 3])


def _table_rows(file: Path, needed: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    """Line number and cells by column of every row."""
    header, cells = read_csv_lines(file)
    missing = [name for name in needed if name not in header]
    if missing:
        raise InputError(f"{file} line 1: no column {missing[0]!r}; columns are {', '.join(header) or 'none'}")
    if not cells:
        raise InputError(f"{file}: no rows; write {','.join(needed)}[,sigma] a row")
    out = []
    for line, row in cells:
        out.append((line, dict(zip(header, (cell.strip() for cell in row), strict=True))))
        if not out[-1][1]["target"]:
            raise InputError(f"{file} line {line}: target is empty; give it a name")
        require_name(f"{file} line {line}", out[-1][1]["target"], "target")
    return out


def _point_numbers(file: Path, line: int, row: dict[str, str]) -> list[float]:
    """x, y, z and sigma, NaN where its cell is empty or the column absent."""
    out = []
    for column in (*_XYZ, "sigma"):
        cell = row.get(column, "")
        if column == "sigma" and not cell:
            out.append(float("nan"))
            continue
        out.append(finite_number(file, line, column, cell))
    if out[3] <= 0:
        raise InputError(f"{file} line {line}: sigma is {out[3]:g}; write a positive number or leave it empty")
    return out
