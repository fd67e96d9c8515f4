"""A robot as URDF (http://wiki.ros.org/urdf/XML), in metres and radians."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.robot import Robot, elementary


def to_urdf(robot: Robot) -> str:
    """Return a robot as URDF text, links base_link, link_1 … link_n, flange; its flange poses are those of the robot.

    T_base_flange(q) = Π before[i] · Rz(theta[i] + q[i]) · after[i]. Masses are point masses. The payload is a further
    link fixed to the flange, so that a reader of the file must not add it again.
    """
    root = ElementTree.Element("robot", name=robot.name or "robot")
    ElementTree.SubElement(root, "link", name="base_link")
    # `carried` is the part of the transform behind the last joint, which the next joint's origin takes up.
    parent, carried = "base_link", np.eye(4)
    for i in range(robot.n_joints):
        origin = carried @ robot.before[i] @ elementary("z", robot.theta[i])
        # In URDF a link's frame is that of its joint; `com` is given in the frame behind `after`.
        centre = frames.transform(robot.after[i], robot.com[i][None])[0] * robot.metres_per_unit
        link = f"link_{i + 1}"
        _add_link(root, link, float(robot.mass[i]), centre)
        _add_joint(root, f"joint_{i + 1}", "continuous", parent, link, origin, robot.metres_per_unit)
        parent, carried = link, robot.after[i]
    _add_link(root, "flange", 0.0, np.zeros(3))
    _add_joint(root, "flange_joint", "fixed", parent, "flange", carried, robot.metres_per_unit)
    if robot.payload_mass:
        _add_link(root, "payload", robot.payload_mass, robot.payload_com * robot.metres_per_unit)
        _add_joint(root, "payload_joint", "fixed", "flange", "payload", np.eye(4), robot.metres_per_unit)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True)


def _add_link(root: ElementTree.Element, name: str, mass: float, com: Array) -> None:
    """Add a link with its mass (kg) and centre of mass (3,), m."""
    link = ElementTree.SubElement(root, "link", name=name)
    if mass:
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=_text(com))
        ElementTree.SubElement(inertial, "mass", value=_text(np.array([mass])))
        # Other readers insist on the element; a point mass has none.
        ElementTree.SubElement(inertial, "inertia", dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0"))


def _add_joint(
    root: ElementTree.Element, name: str, kind: str, parent: str, child: str, T: Array, metres: float
) -> None:
    """Add a joint between two links; it turns about z.

    Args:
        kind: "continuous" or "fixed".
        parent, child: names of the links.
        T: (4, 4) T_parent_joint, length_unit.
        metres: metres per length_unit.
    """
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "origin", xyz=_text(T[:3, 3] * metres), rpy=_text(roll_pitch_yaw(T[:3, :3])))
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    if kind != "fixed":
        ElementTree.SubElement(joint, "axis", xyz="0 0 1")


def roll_pitch_yaw(R: Array) -> Array:
    """Return (3,) roll, pitch and yaw (rad) of a rotation R (3, 3): R = Rz(yaw)·Ry(pitch)·Rx(roll).

    It is exact near a pitch of 90° too: yaw is arbitrary there, but roll is read from Rz(−yaw)·R, so that an error of
    yaw is undone by roll.
    """
    yaw = np.arctan2(R[1, 0], R[0, 0])
    rest = elementary("z", -yaw)[:3, :3] @ R
    return np.array([np.arctan2(-rest[1, 2], rest[1, 1]), np.arctan2(-rest[2, 0], rest[0, 0]), yaw])


def xml_comment(lines: Sequence[str]) -> str:
    """Return lines of comment; two hyphens, which would end one, become a dash."""
    return "".join(f"<!-- {' '.join(line.replace('--', '–').split())} -->\n" for line in lines)


def _text(values: Array) -> str:
    """Return the shortest decimals that read back as the same float64."""
    return " ".join(repr(float(x)) for x in values)
