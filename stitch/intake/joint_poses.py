"""Joint angles as poses, where a URDF lies beside them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.layouts import ColumnLayout
from stitch.intake.raw_poses import RawPoses
from stitch.intake.readings import Reading, angle_units
from stitch.intake.urdf_links import arm_from_urdf
from stitch.measurement.robot import forward

JOINT_ANGLES = "joint angles"


def joint_readings(layout: ColumnLayout, urdf: Path | None, angle_unit: str | None) -> list[Reading]:
    """Poses of joint angles, mm, in every unit that the angles can have.

    Raises:
        InputError: no URDF beside them, or one of another number of joints.
    """
    joints = layout.joints
    assert joints is not None
    if urdf is None:
        raise InputError(
            "joint angles need the robot: put its URDF into the folder, or give poses; with DH rows write session.toml "
            "by hand"
        )
    robot, _, _ = arm_from_urdf(urdf, joints.shape[1])
    out = []
    for place, unit in enumerate(angle_units(joints, angle_unit or layout.angle_unit)):
        T: Array = forward(robot, np.radians(joints) if unit == "deg" else joints)
        out.append(Reading(T, JOINT_ANGLES, unit, replace(layout, length_unit="mm"), 100 * place))
    return out


def joint_layouts(raw: RawPoses) -> list[ColumnLayout]:
    """The meaning of columns without names as joint angles."""
    nothing = np.zeros((len(raw.numbers), 0))
    if raw.numbers.shape[1] not in (6, 7):
        return []
    return [ColumnLayout(nothing, nothing, raw.numbers, "columns are joint angles")]
