"""views.csv: one row per scan, columns by name."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.robot import Robot, forward
from stitch.reading.arm_loads import require_loads
from stitch.reading.csv_lines import read_csv_lines
from stitch.reading.csv_number import finite_number, is_number
from stitch.reading.joint_columns import JOINT, require_joint_columns, require_no_hidden_joints
from stitch.reading.names import require_name
from stitch.reading.reported_pose import POSE_COLUMNS, flange_pose
from stitch.reading.text_file import require_file

_APPROACH = re.compile(r"j([1-9]\d*)_approach$")


@dataclass(frozen=True)
class ViewRow:
    """One row, checked; lengths in length_unit, joints in rad."""

    line: int
    name: str
    cloud: str
    T_base_flange: Array
    joints: Array | None
    approach: Array | None
    time_s: float | None
    covariates: dict[str, float]


def read_views(file: Path, robot: Robot | None) -> list[ViewRow]:
    """Read and check views.csv.

    Columns that hold text in every row (notes) are left alone. Where joints and a reported pose both
    stand, the reported pose is used and must agree with the joints.

    Raises:
        InputError: names the line and how to fix it.
    """
    require_file(file, "a session needs a row per scan there")
    header, lines = read_csv_lines(file)
    _check_header(file, header, robot)
    if not lines:
        raise InputError(f"{file}: no views; write one row per scan")
    cells = [(line, _row_cells(header, row)) for line, row in lines]
    covariates = covariate_names(header, cells)
    joints = [_row_joints(file, line, row, header) for line, row in cells]
    require_loads(file, header, cells, sum(bool(JOINT.match(name)) for name in header))
    rows: list[ViewRow] = []
    seen: dict[str, int] = {}
    latest = -np.inf
    for i, (line, row) in enumerate(cells):
        name = row.get("view", "")
        if not name or name in seen:
            mend = f"is used on line {seen[name]} already" if name else "is empty"
            raise InputError(f"{file} line {line}: view {name!r} {mend}; every view needs an id of its own")
        seen[require_name(f"{file} line {line}", name, "view")] = line
        time_s = finite_number(file, line, "time_s", row["time_s"]) if row.get("time_s") else None
        if time_s is not None:
            _require_later(file, line, time_s, latest)
            latest = time_s
        values = {c: finite_number(file, line, c, row[c]) for c in covariates if row[c]}
        cloud = row.get("cloud", "")
        T_base_flange = flange_pose(file, line, name, row, joints[i], robot)
        approach = _row_approach(file, line, row, joints, i)
        rows.append(ViewRow(line, name, cloud, T_base_flange, joints[i], approach, time_s=time_s, covariates=values))
    require_no_hidden_joints(file, cells, [row.T_base_flange for row in rows], robot)
    return rows


def row_at(file: Path, robot: Robot | None, joints: Array) -> ViewRow:
    """The row of a view that stands in no table, at joint angles (n,) rad.

    Args:
        file: session.toml.

    Raises:
        InputError: no robot, or one with another number of joints.
    """
    if robot is None:
        raise InputError(f"{file}: no [robot], so that joint angles mean nothing; to fix: state its DH rows or URDF")
    if len(joints) != robot.n_joints:
        raise InputError(
            f"{file}: {len(joints)} joint angles, but the robot has {robot.n_joints}; to fix: give one a joint"
        )
    return ViewRow(0, "start", "", forward(robot, joints), joints, np.zeros(len(joints)), time_s=None, covariates={})


def _require_later(file: Path, line: int, time_s: float, latest: float) -> None:
    """Refuse rows out of order: direction of approach, settling and drifts count on it."""
    if time_s < latest:
        raise InputError(
            f"{file} line {line}: time_s {time_s:g} stands below {latest:g}; sort the rows by time, or let it go on "
            "counting"
        )


def _check_header(file: Path, header: Sequence[str], robot: Robot | None) -> None:
    if "view" not in header:
        raise InputError(f"{file} line 1: no column 'view'; columns are {', '.join(header) or 'none'}")
    double = sorted({name for name in header if header.count(name) > 1})
    if double:
        raise InputError(f"{file} line 1: column {double[0]!r} stands twice; rename one")
    numbers = require_joint_columns(file, header, robot)
    pose = [name for name in POSE_COLUMNS if name in header]
    if pose and len(pose) < len(POSE_COLUMNS):
        missing = ", ".join(name for name in POSE_COLUMNS if name not in header)
        raise InputError(f"{file} line 1: a pose needs {', '.join(POSE_COLUMNS)}; missing {missing}")
    if not pose and not numbers:
        raise InputError(
            f"{file} line 1: neither joints (j1_deg …) nor poses ({','.join(POSE_COLUMNS)}); one of them is needed"
        )
    if numbers and not pose and not robot:
        raise InputError(f"{file} line 1: joints without poses need a [robot] in session.toml")


def _row_cells(header: Sequence[str], row: Sequence[str]) -> dict[str, str]:
    return {name: cell.strip() for name, cell in zip(header, row, strict=True)}


def covariate_names(header: Sequence[str], cells: Sequence[tuple[int, dict[str, str]]]) -> list[str]:
    """Columns of numbers that are neither poses nor joints: what errors may follow."""
    known = {"view", "cloud", "time_s", *POSE_COLUMNS}
    rest = [n for n in header if n not in known and not JOINT.match(n) and not _APPROACH.match(n)]
    return [name for name in rest if any(is_number(row[name]) for _, row in cells)]


def _row_joints(file: Path, line: int, row: dict[str, str], header: Sequence[str]) -> Array | None:
    names = [f"j{i}_deg" for i in range(1, sum(bool(JOINT.match(n)) for n in header) + 1)]
    if not names or not any(row[name] for name in names):
        return None
    return np.radians([finite_number(file, line, name, row[name]) for name in names])


def _row_approach(file: Path, line: int, row: dict[str, str], joints: Sequence[Array | None], i: int) -> Array | None:
    q = joints[i]
    if q is None:
        return None
    before = joints[i - 1] if i else None
    out = np.zeros(len(q)) if before is None else np.sign(q - before)
    for k in range(len(q)):
        cell = row.get(f"j{k + 1}_approach", "")
        if cell:
            out[k] = finite_number(file, line, f"j{k + 1}_approach", cell)
            if out[k] not in (-1, 0, 1):
                raise InputError(f"{file} line {line}: j{k + 1}_approach is {cell}; use -1, 0 or 1")
    return out
