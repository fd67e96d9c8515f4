"""Columns of joint angles in views.csv: called as the format calls them, none missing."""

import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.robot import Robot, forward
from stitch.reading.csv_number import is_number

JOINT = re.compile(r"j([1-9]\d*)_deg$")
_OTHER_JOINT_NAME = re.compile(r"(?:j|joint|axis|a|q|theta)[_ ]?([1-9]\d?)(?:[_ ]?[\[(]?(?:deg|rad|°)[\])]?)?", re.I)
_LISTED_COLUMNS = 4
# Angles that give the reported poses this closely are those of the joints.
_ANGLE, _REACH = np.radians(2.0), 0.02


def require_joint_columns(file: Path, header: Sequence[str], robot: Robot | None) -> list[int]:
    """Numbers of the joints that have a column.

    Raises:
        InputError: one is missing, or there are more or fewer than the robot has joints.
    """
    found = sorted(int(m.group(1)) for name in header if (m := JOINT.match(name)))
    if not found:
        return found
    count = max(found[-1], robot.n_joints if robot else 0)
    missing = list(islice((i for i in range(1, count + 1) if i not in found), _LISTED_COLUMNS))
    told = ", ".join(f"j{i}_deg" for i in missing)
    if missing and missing[0] < found[-1]:
        raise InputError(
            f"{file} line 1: no column {told}; joint columns must be j1_deg … jN_deg without a gap; to fix: add it"
        )
    if robot and len(found) != robot.n_joints:
        mend = f"add {told}" if missing else "leave out those beyond, or correct [robot] in session.toml"
        raise InputError(
            f"{file} line 1: {len(found)} joint columns, but the robot has {robot.n_joints}; to fix: {mend}"
        )
    return found


def require_no_hidden_joints(
    file: Path, cells: Sequence[tuple[int, dict[str, str]]], poses: Sequence[Array], robot: Robot | None
) -> None:
    """Refuse columns whose names and numbers are those of joint angles, and that would count as covariates.

    Args:
        poses: (4, 4) T_base_flange of every row; columns that do not lead there are covariates, whatever their names.

    Raises:
        InputError: names the columns, and what to call them.
    """
    header = [*cells[0][1]] if cells else []
    names = [] if any(map(JOINT.match, header)) else _otherwise_named_joints(header)
    if robot is None or not names or len(names) != robot.n_joints:
        return
    rows = [([row[name] for name in names], T) for (_, row), T in zip(cells, poses, strict=True)]
    table = [([float(cell) for cell in row], T) for row, T in rows if all(map(is_number, row))]
    for unit, factor in (("", np.pi / 180), (", in degrees", 1.0)):
        if table and all(_reaches_pose(robot, factor * np.array(joints), T) for joints, T in table):
            raise InputError(
                f"{file} line 1: columns {', '.join(names)} hold the joint angles of the robot; to fix: call them "
                f"j1_deg … j{len(names)}_deg{unit}"
            )


def _otherwise_named_joints(header: Sequence[str]) -> list[str]:
    """Columns J1, J2 …, in the order of their numbers; none where one is missing or twice."""
    found = {name: int(m.group(1)) for name in header if (m := _OTHER_JOINT_NAME.fullmatch(name))}
    names = sorted(found, key=lambda name: found[name])
    return names if [found[name] for name in names] == [*range(1, len(names) + 1)] else []


def _reaches_pose(robot: Robot, joints: Array, T: Array) -> bool:
    if not np.isfinite(joints).all():
        return False
    told = forward(robot, joints)
    distance = np.linalg.norm(T[:3, 3] - told[:3, 3])
    return bool(frames.angle_between(T, told) <= _ANGLE and distance <= _REACH * np.linalg.norm(told[:3, 3]))
