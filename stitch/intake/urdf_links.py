"""Between which links of a URDF the arm lies: the root, and what people call the flange."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.measurement.robot import Robot
from stitch.reading.urdf import robot_from_urdf

# tool0 and flange are those of ROS-Industrial.
_FLANGES = ("tool0", "flange", "ee_link", "tcp")
_GRAVITY = np.array([0.0, 0.0, -9.81])


def arm_from_urdf(urdf: Path, joints: int) -> tuple[Robot, str, str]:
    """The arm of so many joints, mm, with the links that it lies between.

    Raises:
        InputError: unreadable, or no chain of so many joints.
    """
    reasons = [f"{urdf}: not a readable URDF; to fix: export it as plain URDF"]
    for base, flange in arm_link_pairs(urdf):
        try:
            robot = robot_from_urdf(urdf, base, flange, "mm", _GRAVITY)
        except InputError as error:
            reasons.append(str(error))
            continue
        if robot.n_joints == joints:
            return robot, base, flange
        reasons.append(f"{urdf}: has {robot.n_joints} joints, the table {joints}; to fix: name the columns (--columns)")
    raise InputError(reasons[-1])


def arm_link_pairs(urdf: Path) -> list[tuple[str, str]]:
    """Root and flange by name, else root and the child of each turning joint, the last first."""
    try:
        root = ElementTree.parse(urdf).getroot()
    except (OSError, ValueError, LookupError, ElementTree.ParseError):
        return []
    links = [str(link.get("name")) for link in root.findall("link")]
    ends = [(j.get("type"), getattr(j.find("child"), "attrib", {}).get("link")) for j in root.findall("joint")]
    children = {child for _, child in ends}
    base = next((name for name in links if name not in children), None)
    turned = [str(child) for kind, child in ends if kind in ("revolute", "continuous")]
    flanges = [name for name in _FLANGES if name in links] + turned[::-1]
    return [] if base is None else [(base, flange) for flange in flanges]
