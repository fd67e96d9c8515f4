"""Poses as CSV rows: x, y, z and the angles a, b, c in degrees, turned about z, y', x'' in this order."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.cells.csv_table import CsvColumns
from stitch.cells.job_toml import check_keys, finite
from stitch.frames import Array

POSE_COLUMNS = "x y z a_deg b_deg c_deg"


def poses_from_rows(numbers: Array) -> Array:
    """Poses (..., 4, 4) from rows (..., 6)."""
    numbers = np.asarray(numbers, float)
    R = Rotation.from_euler("ZYX", numbers[..., 3:].reshape(-1, 3), degrees=True).as_matrix()
    return frames.make(R.reshape(*numbers.shape[:-1], 3, 3), numbers[..., :3])


def rows_from_poses(poses: Array) -> Array:
    """Rows (N, 6) from poses (N, 4, 4)."""
    poses = np.asarray(poses, float)
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX", degrees=True)])


def poses_from_columns(table: CsvColumns) -> Array:
    """Poses (N, 4, 4) of a table that holds the six columns."""
    return poses_from_rows(table.stack(POSE_COLUMNS))


def pose_from_table(file: Path, place: str, entries: Any) -> Array:
    """The pose (4, 4) that a table of a job file holds, by the keys of COLUMNS.

    Raises:
        InputError: no table, an unknown key, or something that is no finite number.
    """
    check_keys(file, place, entries, set(POSE_COLUMNS.split()))
    return poses_from_rows(np.array([finite(file, f"{place}.{key}", entries.get(key)) for key in POSE_COLUMNS.split()]))


def write_poses(file: Path, key: str, names: Sequence[str], poses: Array) -> None:
    """A CSV of named poses (N, 4, 4)."""
    rows = np.round(rows_from_poses(poses), 6) + 0.0
    columns = {name: rows[:, i] for i, name in enumerate(POSE_COLUMNS.split())}
    write_columns(file, {key: list(names), **columns})


def write_columns(file: Path, columns: Mapping[str, Sequence[object] | Array]) -> None:
    """A CSV with a header; numbers keep nine digits."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow([f"{value:.9g}" if isinstance(value, float) else value for value in row])
