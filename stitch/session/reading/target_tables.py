"""points.csv, frames.csv and targets.csv: what a sensor shows by name, and where a drawing puts it."""

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.session.reading.csv_files import finite_number, read_csv_rows, require_unit_quaternion
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
    for line, row in _target_rows(file, ("view", "target", *_XYZ)):
        view, target = row["view"], row["target"]
        _require_view(file, line, view, known)
        if (view, target) in lines:
            raise InputError(
                f"{file} line {line}: view {view} shows target {target} on line {lines[view, target]} already; "
                "leave one out, or name it otherwise"
            )
        lines[view, target] = line
        rows.setdefault(view, {})[target] = _point_numbers(file, line, row)
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
    for line, row in _target_rows(file, ("target", *_XYZ)):
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
    for line, row in _table_rows(file, ("view", *_POSE), f"{file}: no poses; write one row per view"):
        name = row["view"]
        if name in lines:
            raise InputError(f"{file} line {line}: view {name} stands on line {lines[name]} already; leave one out")
        _require_view(file, line, name, known)
        lines[name] = line
        pose = np.array([finite_number(file, line, column, row[column]) for column in _POSE])
        require_unit_quaternion(f"{file} line {line}", pose[3:])
        T = frames.from_quaternion(pose[:3], pose[3:])
        sigma = _column_sigma(file, line, row, "sigma")
        sigma_rotation = float(np.radians(_column_sigma(file, line, row, "sigma_deg")))
        sightings[name] = Sighting((_PROBE,), T[None, :3, 3], np.array([sigma]), T[:3, :3], sigma_rotation)
    return sightings


def _table_rows(file: Path, needed: Sequence[str], empty: str) -> list[tuple[int, dict[str, str]]]:
    """Return for every row of a table its line number and column -> cell, stripped.

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


def _target_rows(file: Path, needed: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    """Return for every row of a table its line number and column -> cell; each row must name a target.

    Raises:
        InputError: as `_table_rows`, or a name is empty or cannot be printed.
    """
    rows = _table_rows(file, needed, f"{file}: no rows; write {','.join(needed)}[,sigma] a row")
    for line, row in rows:
        if not row["target"]:
            raise InputError(f"{file} line {line}: target is empty; give it a name")
        require_name(f"{file} line {line}", row["target"], "target")
    return rows


def _require_view(file: Path, line: int, view: str, known: Collection[str]) -> None:
    """Refuse the name of a view that views.csv does not have.

    Raises:
        InputError: names the line.
    """
    if view not in known:
        raise InputError(
            f"{file} line {line}: view {shortened(view)} is not in views.csv; add it there or remove the row"
        )


def _point_numbers(file: Path, line: int, row: dict[str, str]) -> list[float]:
    """Return x, y, z and sigma of a row, length_unit; sigma is NaN where its cell is empty or the column absent.

    Args:
        row: column -> cell.

    Raises:
        InputError: no number, or a sigma that is not positive.
    """
    place = [finite_number(file, line, column, row[column]) for column in _XYZ]
    sigma = finite_number(file, line, "sigma", row["sigma"]) if row.get("sigma") else float("nan")
    if sigma <= 0:
        raise InputError(f"{file} line {line}: sigma is {sigma:g}; write a positive number or leave it empty")
    return [*place, sigma]


def _column_sigma(file: Path, line: int, row: dict[str, str], column: str) -> float:
    """Return the standard deviation in a column of a row; NaN where the table has no such column.

    Raises:
        InputError: the cell is empty, no number, or not positive.
    """
    sigma = finite_number(file, line, column, row[column]) if column in row else float("nan")
    if sigma <= 0:
        raise InputError(f"{file} line {line}: {column} is {sigma:g}; write a positive number")
    return sigma
