"""The pose of the flange in a row of views.csv: as it is reported, or from the joints."""

from pathlib import Path

import numpy as np

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.robot import Robot, forward
from stitch.reading.csv_lines import read_csv_lines
from stitch.reading.csv_number import finite_number

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
# A quaternion with six digits is unit within 1e-6; beyond 1e-3 something else is written there.
_FLANGE_QUATERNION_TOLERANCE = 1e-3
# Joints and reported pose of a nominal model differ by the calibration (mm, tenths of a degree);
# degrees and percents of the reach are another convention.
_ANGLE_TOLERANCE = np.radians(2.0)
_REACH_TOLERANCE = 0.02


def has_reported_poses(file: Path) -> bool:
    """True if some row of a views.csv that was read before reports a pose; False where there is no such file."""
    if not file.is_file():
        return False
    header, rows = read_csv_lines(file)
    columns = [k for k, name in enumerate(header) if name in POSE_COLUMNS]
    return any(cells[k].strip() for _, cells in rows for k in columns)


def flange_pose(
    file: Path, line: int, name: str, row: dict[str, str], joints: Array | None, robot: Robot | None
) -> Array:
    """(4, 4) T_base_flange of a view; a reported pose is used where it stands, and must agree with the joints.

    Args:
        row: cells by their column.
        joints: (n,) rad.

    Raises:
        InputError: neither stands there, or what stands there is no pose, or not that of the joints.
    """
    from_joints = forward(robot, joints) if robot and joints is not None else None
    given = [row.get(column, "") for column in POSE_COLUMNS]
    if not any(given):
        if from_joints is None:
            raise InputError(
                f"{file} line {line}: view {name} has no pose; fill {','.join(POSE_COLUMNS)} or the joints, or remove the row"
            )
        return from_joints
    values = np.array([finite_number(file, line, c, cell) for c, cell in zip(POSE_COLUMNS, given, strict=True)])
    norm = float(np.linalg.norm(values[3:]))
    if abs(norm - 1) > _FLANGE_QUATERNION_TOLERANCE:
        raise InputError(
            f"{file} line {line}: view {name}: qx,qy,qz,qw has length {norm:.4f}, not a rotation; "
            "write a unit quaternion, w last"
        )
    reported = frames.from_quaternion(values[:3], values[3:] / norm)
    if robot is not None and from_joints is not None:
        require_agreement(f"{file} line {line}: view {name}", reported, from_joints, robot.metres_per_unit)
    return reported


def require_agreement(where: str, reported: Array, from_joints: Array, metres: float) -> None:
    """Refuse a reported pose (4, 4) that is not that of the joints.

    Args:
        where: row and view, for messages.
        metres: in one length_unit.

    Raises:
        InputError: by how much they differ, and what to check.
    """
    angle = float(frames.angle_between(reported, from_joints))
    distance = float(np.linalg.norm(reported[:3, 3] - from_joints[:3, 3]))
    reach = float(np.linalg.norm(from_joints[:3, 3]))
    if angle > _ANGLE_TOLERANCE or distance > _REACH_TOLERANCE * reach:
        raise InputError(
            f"{where}: joints and reported pose differ by {1e3 * metres * distance:.4g} mm and "
            f"{np.degrees(angle):.3g}°; check robot.dh, theta_deg, length_unit, or leave one of them out"
        )
