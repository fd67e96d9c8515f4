"""views.csv: one row per scan, columns by name.

A row has the pose of the flange, reported or from joint angles, and maybe time, loads of the arm, and numbers that
errors may follow.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.axes import Axis
from stitch.session.reading.csv_files import TableRow, is_number, read_csv_rows, require_unit_quaternion
from stitch.session.reading.text_files import require_file, require_name
from stitch.session.robot import Robot, forward
from stitch.session.session import View

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_JOINT = re.compile(r"j([1-9]\d*)_deg$")
_OTHER_JOINT_NAME = re.compile(r"(?:j|joint|axis|a|q|theta)[_ ]?([1-9]\d?)(?:[_ ]?[\[(]?(?:deg|rad|°)[\])]?)?", re.I)
_APPROACH = re.compile(r"j([1-9]\d*)_approach$")
_PAYLOAD = "payload_kg"
_TORQUE = re.compile(r"j([1-9]\d*)_torque_nm$")
# No arm carries a hundred tonnes, no drive exerts a million N·m.
_LARGEST_KG = 1e5
_LARGEST_NM = 1e6
_LISTED_COLUMNS = 4
# Joints and reported pose of a nominal model differ by the calibration (mm, tenths of a degree);
# degrees and percents of the reach are another convention.
_ANGLE_TOLERANCE = np.radians(2.0)
_REACH_TOLERANCE = 0.02


@dataclass(frozen=True)
class ViewRow:
    """One row, checked."""

    line: int
    cloud: str  # file of its scan; empty where it names none
    view: View  # without what was seen; lengths in length_unit


def read_views(file: Path, robot: Robot | None, axes: Sequence[Axis] = (), length_unit: str = "mm") -> list[ViewRow]:
    """Return the rows of views.csv, checked.

    Columns that hold text in every row (notes) are passed over. Where a row has joints and a reported pose, the
    reported pose is used and must agree with the joints.

    Args:
        file: views.csv.
        robot: None: its kinematics are not known, so that every row needs a pose.
        axes: external axes; each needs a column of readings. With axes alone, poses are the identity.
        length_unit: of positions.

    Raises:
        InputError: names the line and how to fix it.
    """
    require_file(file, "a session needs a row per scan there")
    header, table = read_csv_rows(file)
    columns = [_axis_column(file, header, axis, length_unit) for axis in axes]
    joint_count = _check_header(file, header, robot, has_axes=bool(axes))
    if not table:
        raise InputError(f"{file}: no views; write one row per scan")
    covariates = covariate_names(header, table)
    joints = [_row_joints(row, joint_count) for row in table]
    for row in table:
        for column in columns:
            row.number(column, "write the axis' reading in every row")
    require_loads(file, header, table, joint_count)
    _require_own_names(table)
    times = _row_times(table)
    has_poses = has_pose_columns(header) or not axes
    rows: list[ViewRow] = []
    for i, row in enumerate(table):
        view = View(
            name=row["view"],
            cloud=None,
            covariates={column: row.number(column) for column in covariates if row[column]},
            T_base_flange=_flange_pose(row, joints[i], robot) if has_poses else np.eye(4),
            joints=joints[i],
            approach=_row_approach(row, joints[i], joints[i - 1] if i else None),
            time_s=times[i],
        )
        rows.append(ViewRow(row.line, row.get("cloud", ""), view))
    _require_no_hidden_joints(table, [row.view.T_base_flange for row in rows], robot)
    return rows


def _require_own_names(table: Sequence[TableRow]) -> None:
    """Refuse views whose name is empty, that of another view, or cannot be printed.

    Raises:
        InputError: names the line.
    """
    lines: dict[str, int] = {}
    for row in table:
        name = row["view"]
        if not name or name in lines:
            wrong = f"is used on line {lines[name]} already" if name else "is empty"
            raise InputError(f"{row.where}: view {name!r} {wrong}; every view needs an id of its own")
        lines[require_name(row.where, name, "view")] = row.line


def _row_times(table: Sequence[TableRow]) -> list[float | None]:
    """Return the time of each row, s; None where the row states none.

    Raises:
        InputError: a time before that of an earlier row: approach, settling and drifts count on the order.
    """
    times: list[float | None] = []
    latest = -np.inf
    for row in table:
        time_s = row.number("time_s") if row.get("time_s") else None
        times.append(time_s)
        if time_s is None:
            continue
        if time_s < latest:
            raise InputError(
                f"{row.where}: time_s {time_s:g} stands below {latest:g}; sort the rows by time, or let it go "
                "on counting"
            )
        latest = time_s
    return times


def has_pose_columns(header: Sequence[str]) -> bool:
    """Return whether a header has columns of poses or of joint angles."""
    return any(name in POSE_COLUMNS or _JOINT.match(name) for name in header)


def _axis_column(file: Path, header: Sequence[str], axis: Axis, length_unit: str) -> str:
    """Return the name of the column that holds an axis' readings: NAME_deg, NAME_mm or NAME_m.

    Raises:
        InputError: none, or two of them.
    """
    possible = axis.columns(length_unit)
    stated = [name for name in header if name in possible]
    if len(stated) != 1:
        words = " or ".join(possible)
        raise InputError(
            f"{file} line 1: axis {axis.name} has {len(stated)} columns of readings; to fix: give it one, {words}"
        )
    return stated[0]


def row_at(file: Path, robot: Robot | None, joints: Array) -> ViewRow:
    """Return a row as of views.csv, for a view named "start" at joint angles (n,) rad.

    Args:
        file: session.toml, for messages.

    Raises:
        InputError: no robot, or one with another number of joints.
    """
    if robot is None:
        raise InputError(f"{file}: no [robot], so that joint angles mean nothing; to fix: state its DH rows or URDF")
    if len(joints) != robot.n_joints:
        raise InputError(
            f"{file}: {len(joints)} joint angles, but the robot has {robot.n_joints}; to fix: give one a joint"
        )
    still = np.zeros(len(joints))
    return ViewRow(0, "", View("start", None, forward(robot, joints), joints, still, time_s=None, covariates={}))


def _check_header(file: Path, header: Sequence[str], robot: Robot | None, has_axes: bool = False) -> int:
    """Check the names of the columns of views.csv; return the number of joint columns, 0 without any.

    Args:
        has_axes: external axes have columns, so that neither poses nor joints are needed.

    Raises:
        InputError: neither poses nor joint angles, some of their columns alone, or a column twice.
    """
    if "view" not in header:
        raise InputError(f"{file} line 1: no column 'view'; columns are {', '.join(header) or 'none'}")
    double = sorted({name for name in header if header.count(name) > 1})
    if double:
        raise InputError(f"{file} line 1: column {double[0]!r} stands twice; rename one")
    joint_count = _require_joint_columns(file, header, robot)
    missing = [name for name in POSE_COLUMNS if name not in header]
    if 0 < len(missing) < len(POSE_COLUMNS):
        raise InputError(f"{file} line 1: a pose needs {', '.join(POSE_COLUMNS)}; missing {', '.join(missing)}")
    if missing and not joint_count and not has_axes:
        raise InputError(
            f"{file} line 1: neither joints (j1_deg …) nor poses ({','.join(POSE_COLUMNS)}); one of them is needed"
        )
    if missing and joint_count and not robot:
        raise InputError(f"{file} line 1: joints without poses need a [robot] in session.toml")
    return joint_count


def _require_joint_columns(file: Path, header: Sequence[str], robot: Robot | None) -> int:
    """Return the number of joint columns j1_deg … jN_deg: that of the robot's joints, or 0.

    Without a robot any number without a gap is allowed.

    Raises:
        InputError: a gap, or another number than the robot has.
    """
    numbers = sorted(int(match[1]) for name in header if (match := _JOINT.match(name)))
    if not numbers:
        return 0
    count = max(numbers[-1], robot.n_joints if robot else 0)
    missing = list(islice((i for i in range(1, count + 1) if i not in numbers), _LISTED_COLUMNS))
    columns = ", ".join(f"j{i}_deg" for i in missing)
    if missing and missing[0] < numbers[-1]:
        raise InputError(
            f"{file} line 1: no column {columns}; joint columns must be j1_deg … jN_deg without a gap; to fix: add it"
        )
    if robot and len(numbers) != robot.n_joints:
        mend = f"add {columns}" if missing else "leave out those beyond, or correct [robot] in session.toml"
        raise InputError(
            f"{file} line 1: {len(numbers)} joint columns, but the robot has {robot.n_joints}; to fix: {mend}"
        )
    return len(numbers)


def covariate_names(header: Sequence[str], table: Sequence[TableRow]) -> list[str]:
    """Return the names of the columns that hold a number in some row and are neither poses, joints nor time."""
    return [name for name in header if _may_be_covariate(name) and any(is_number(row[name]) for row in table)]


def _may_be_covariate(column: str) -> bool:
    """Return whether a column of views.csv has no meaning of its own, as poses, joints and times have."""
    return column not in {"view", "cloud", "time_s", *POSE_COLUMNS} and not (
        _JOINT.match(column) or _APPROACH.match(column)
    )


def require_covariate_name(where: str, name: str) -> str:
    """Return the name of a covariate as it is, if views.csv can have a column of that name.

    Args:
        where: for the message.

    Raises:
        InputError: the name of another column, empty, with blanks at its ends, or not printable.
    """
    require_name(where, name, "covariate")
    if not name or name != name.strip() or not _may_be_covariate(name):
        raise InputError(f"{where}: {name!r} can be no covariate's name in views.csv; to fix: give it another one")
    return name


def _row_joints(row: TableRow, count: int) -> Array | None:
    """Return the joint angles (count,) of a row, rad; None where all their cells are empty."""
    names = [f"j{i + 1}_deg" for i in range(count)]
    if not any(row[name] for name in names):
        return None
    return np.radians([row.number(name) for name in names])


def _row_approach(row: TableRow, joints: Array | None, before: Array | None) -> Array | None:
    """Return the direction (n,) from which each joint came, −1, 0 or +1; None without joints.

    As the columns jN_approach state it, else the sign of the change since the row before; 0 in the first row.

    Args:
        joints, before: (n,) rad, of this row and of the one before; None: it has none.
    """
    if joints is None:
        return None
    approach = np.zeros(len(joints)) if before is None else np.sign(joints - before)
    for k in range(len(joints)):
        column = f"j{k + 1}_approach"
        if row.get(column):
            approach[k] = row.number(column)
            if approach[k] not in (-1, 0, 1):
                raise InputError(f"{row.where}: {column} is {row[column]}; use -1, 0 or 1")
    return approach


def require_loads(file: Path, header: Sequence[str], table: Sequence[TableRow], joints: int) -> None:
    """Refuse torques or payloads that only some views or some joints have: gravity would silently stand in for them.

    Args:
        joints: number of joints in the table.

    Raises:
        InputError: names the line or the columns, and how to fix it.
    """
    filled = [name for name in header if any(row[name] for row in table)]
    torques = [name for name in filled if _TORQUE.match(name)]
    if torques and joints and sorted(torques) != sorted(f"j{i + 1}_torque_nm" for i in range(joints)):
        raise InputError(
            f"{file} line 1: torques of {', '.join(torques)}, but the table has {joints} joints; to fix: write one "
            "column a joint, or take them out"
        )
    for name in [*torques, *(name for name in filled if name == _PAYLOAD)]:
        for row in table:
            value = row.number(name, "write a number in every row, or take the column out")
            if name == _PAYLOAD and value < 0:
                raise InputError(f"{row.where}: {name} is {value:g}; to fix: write a mass, 0 for none")
            if abs(value) > (_LARGEST_KG if name == _PAYLOAD else _LARGEST_NM):
                raise InputError(f"{row.where}: {name} is {value:g}, as on no arm; to fix: correct its unit")


def _flange_pose(row: TableRow, joints: Array | None, robot: Robot | None) -> Array:
    """Return T_base_flange (4, 4) of a row, length_unit: the reported pose, else the one computed from the joints.

    Args:
        joints: (n,) rad; None: the row has none.

    Raises:
        InputError: the row has neither, its quaternion is not of unit length, or the pose disagrees with the joints.
    """
    where = f"{row.where}: view {row['view']}"
    from_joints = forward(robot, joints) if robot and joints is not None else None
    if not any(row.get(column) for column in POSE_COLUMNS):
        if from_joints is None:
            raise InputError(f"{where} has no pose; fill {','.join(POSE_COLUMNS)} or the joints, or remove the row")
        return from_joints
    values = np.array([row.number(column) for column in POSE_COLUMNS])
    norm = require_unit_quaternion(where, values[3:])
    reported = frames.from_quaternion(values[:3], values[3:] / norm)
    if robot is not None and from_joints is not None:
        require_same_pose(where, reported, from_joints, robot.metres_per_unit)
    return reported


def require_same_pose(where: str, reported: Array, from_joints: Array, metres_per_unit: float) -> None:
    """Refuse a reported pose that differs from the one computed from the joints by more than the tolerances.

    `_ANGLE_TOLERANCE`, and `_REACH_TOLERANCE` of the reach: more is another convention, not an uncalibrated arm.

    Args:
        where: row and view, for messages.
        reported, from_joints: (4, 4) T_base_flange, length_unit.
        metres_per_unit: of lengths.

    Raises:
        InputError: by how much they differ, in mm and °, and what to check.
    """
    angle, distance, agree = _compare_poses(reported, from_joints)
    if not agree:
        raise InputError(
            f"{where}: joints and reported pose differ by {1e3 * metres_per_unit * distance:.4g} mm and "
            f"{np.degrees(angle):.3g}°; check robot.dh, theta_deg, length_unit, or leave one of them out"
        )


def _require_no_hidden_joints(table: Sequence[TableRow], poses: Sequence[Array], robot: Robot | None) -> None:
    """Refuse joint angles in columns of other names, as J1 …, which would silently count as covariates.

    Columns are joint angles if, in degrees or in radians, the robot's kinematics lead from them to the poses.

    Args:
        poses: T_base_flange (4, 4) of every row.

    Raises:
        InputError: names the columns, and what to call them.
    """
    header = list(table[0])
    names = [] if any(map(_JOINT.match, header)) else _otherwise_named_joints(header)
    if robot is None or not names or len(names) != robot.n_joints:
        return
    cells = [([row[name] for name in names], T) for row, T in zip(table, poses, strict=True)]
    filled = [([float(cell) for cell in of_row], T) for of_row, T in cells if all(map(is_number, of_row))]
    for unit, factor in (("", np.pi / 180), (", in degrees", 1.0)):
        if filled and all(_reaches_pose(robot, factor * np.array(joints), T) for joints, T in filled):
            raise InputError(
                f"{table[0].file} line 1: columns {', '.join(names)} hold the joint angles of the robot; to fix: call "
                f"them j1_deg … j{len(names)}_deg{unit}"
            )


def _otherwise_named_joints(header: Sequence[str]) -> list[str]:
    """Return the columns named like joints, as J1 or axis_1, in the order of their numbers from 1.

    Empty where a number is missing or repeated.
    """
    numbers = {name: int(match[1]) for name in header if (match := _OTHER_JOINT_NAME.fullmatch(name))}
    names = sorted(numbers, key=lambda name: numbers[name])
    return names if [numbers[name] for name in names] == [*range(1, len(names) + 1)] else []


def _reaches_pose(robot: Robot, joints: Array, T: Array) -> bool:
    """Return True if joint angles (n,) rad lead to T_base_flange T (4, 4), within `require_same_pose`'s tolerances."""
    return bool(np.isfinite(joints).all()) and _compare_poses(T, forward(robot, joints))[2]


def _compare_poses(reported: Array, from_joints: Array) -> tuple[float, float, bool]:
    """Return angle, rad, and distance, length_unit, between two poses T_base_flange (4, 4), and whether they agree.

    They do if both are within their tolerances; that of the distance counts in the flange's distance from the base.
    """
    angle = float(frames.angle_between(reported, from_joints))
    distance = float(np.linalg.norm(reported[:3, 3] - from_joints[:3, 3]))
    reach = float(np.linalg.norm(from_joints[:3, 3]))
    return angle, distance, angle <= _ANGLE_TOLERANCE and distance <= _REACH_TOLERANCE * reach
