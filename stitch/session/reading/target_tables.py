"""points.csv, frames.csv and targets.csv: what a sensor shows by name, and where a drawing puts it."""

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.session.reading.csv_files import TableRow, read_csv_rows, require_unit_quaternion
from stitch.session.reading.text_files import require_file, require_name, shortened
from stitch.session.session import NominalTargets, Sighting

_XYZ = ("x", "y", "z")
_POSE = (*_XYZ, "qx", "qy", "qz", "qw")
# What the one target of a view of frames.csv is called.
_PROBE = "probe"


def read_points(file: Path, known: Collection[str]) -> dict[str, Sighting]:
    """Return view -> its labelled points, sensor frame, from points.csv; sigma NaN where none is stated.

    Args:
        file: points.csv.
        known: names of the views of views.csv.

    Raises:
        InputError: names the line and how to fix it.
    """
    rows: dict[str, dict[str, list[float]]] = {}
    lines: dict[tuple[str, str], int] = {}
    for row in _target_rows(file, ("view", "target", *_XYZ)):
        view, target = row["view"], row["target"]
        _require_view(row, known)
        if (view, target) in lines:
            raise InputError(
                f"{row.where}: view {view} shows target {target} on line {lines[view, target]} already; "
                "leave one out, or name it otherwise"
            )
        lines[view, target] = row.line
        rows.setdefault(view, {})[target] = _point_numbers(row)
    sightings = {}
    for view, targets in rows.items():
        numbers = np.array(list(targets.values()))
        sightings[view] = Sighting(tuple(targets), numbers[:, :3], numbers[:, 3])
    return sightings


def read_targets(file: Path, sighted: Sequence[str]) -> NominalTargets:
    """Return the nominal positions of targets.csv, part frame; sigma NaN where none is stated.

    Args:
        file: targets.csv.
        sighted: targets of points.csv; one of them at least must be in the file.

    Raises:
        InputError: names the line and how to fix it.
    """
    lines: dict[str, int] = {}
    table = []
    for row in _target_rows(file, ("target", *_XYZ)):
        _add_line(lines, row, "target")
        table.append(_point_numbers(row))
    if not set(lines) & set(sighted):
        raise InputError(
            f"{file}: none of its targets ({', '.join(list(lines)[:4])}) is seen in points.csv "
            f"({', '.join(list(sighted)[:4])}); use the same names, or remove the file"
        )
    numbers = np.array(table)
    return NominalTargets(tuple(lines), numbers[:, :3], numbers[:, 3])


def read_frames(file: Path, known: Collection[str]) -> dict[str, Sighting]:
    """Return view -> the pose of the probe (tracker) or board (camera) in the sensor's frame, from frames.csv.

    Args:
        file: frames.csv.
        known: names of the views of views.csv.

    Raises:
        InputError: names the line and how to fix it.
    """
    require_file(file, f"a frames session needs {','.join(('view', *_POSE))} there")
    sightings: dict[str, Sighting] = {}
    lines: dict[str, int] = {}
    for row in _table_rows(file, ("view", *_POSE), f"{file}: no poses; write one row per view"):
        _add_line(lines, row, "view")
        _require_view(row, known)
        pose = np.array([row.number(column) for column in _POSE])
        require_unit_quaternion(row.where, pose[3:])
        T = frames.from_quaternion(pose[:3], pose[3:])
        sigma = _column_sigma(row, "sigma")
        sigma_rotation = float(np.radians(_column_sigma(row, "sigma_deg")))
        sightings[row["view"]] = Sighting((_PROBE,), T[None, :3, 3], np.array([sigma]), T[:3, :3], sigma_rotation)
    return sightings


def _add_line(lines: dict[str, int], row: TableRow, column: str) -> None:
    """Add the line of a row under its name in a column, target or view.

    Raises:
        InputError: the name stands on another line already.
    """
    name = row[column]
    if name in lines:
        raise InputError(f"{row.where}: {column} {name} stands on line {lines[name]} already; leave one out")
    lines[name] = row.line


def _table_rows(file: Path, needed: Sequence[str], empty: str) -> list[TableRow]:
    """Return the rows of a table that has some columns, and a row at least.

    Args:
        needed: columns that the table must have.
        empty: message for a table without rows.

    Raises:
        InputError: a column is missing, there is no row, or the file cannot be read.
    """
    header, rows = read_csv_rows(file)
    missing = [name for name in needed if name not in header]
    if missing:
        raise InputError(f"{file} line 1: no column {missing[0]!r}; columns are {', '.join(header) or 'none'}")
    if not rows:
        raise InputError(empty)
    return rows


def _target_rows(file: Path, needed: Sequence[str]) -> list[TableRow]:
    """Return the rows of a table, each of which names a target.

    Raises:
        InputError: as `_table_rows`, or a name is empty or cannot be printed.
    """
    rows = _table_rows(file, needed, f"{file}: no rows; write {','.join(needed)}[,sigma] a row")
    for row in rows:
        if not row["target"]:
            raise InputError(f"{row.where}: target is empty; give it a name")
        require_name(row.where, row["target"], "target")
    return rows


def _require_view(row: TableRow, known: Collection[str]) -> None:
    """Refuse a row of a view that views.csv does not have.

    Raises:
        InputError: names the line.
    """
    view = row["view"]
    if view not in known:
        raise InputError(f"{row.where}: view {shortened(view)} is not in views.csv; add it there or remove the row")


def _point_numbers(row: TableRow) -> list[float]:
    """Return x, y, z and sigma of a row, length_unit; sigma is NaN where its cell is empty or the column absent.

    Raises:
        InputError: no number, or a sigma that is not positive.
    """
    place = [row.number(column) for column in _XYZ]
    sigma = row.number("sigma") if row.get("sigma") else float("nan")
    if sigma <= 0:
        raise InputError(f"{row.where}: sigma is {sigma:g}; write a positive number or leave it empty")
    return [*place, sigma]


def _column_sigma(row: TableRow, column: str) -> float:
    """Return the standard deviation in a column of a row; NaN where the table has no such column.

    Raises:
        InputError: the cell is empty, no number, or not positive.
    """
    sigma = row.number(column) if column in row else float("nan")
    if sigma <= 0:
        raise InputError(f"{row.where}: {column} is {sigma:g}; write a positive number")
    return sigma
