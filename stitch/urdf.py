"""Robots from URDF, and to URDF. URDF counts in metres and radians."""

import warnings
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.robot import METRES, Robot


def robot_from_urdf(
    path: Path, base_link: str | None, flange_link: str | None, length_unit: str, gravity: Array,
    payload: dict[str, Any] | None = None,
) -> Robot:  # fmt: skip
    """The serial chain base_link → flange_link; masses of links fixed to a moving one are not counted.

    Raises:
        InputError: no such link, no chain between them, or a joint that does not turn.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(f"{path}: not a readable URDF: {error}") from None
    chain = _chain(path, root, base_link, flange_link)
    links = {link.get("name"): link for link in root.iter("link")}
    scale = 1 / METRES[length_unit]
    before: list[Array] = []
    after: list[Array] = []
    mass, com = [], []
    pending = np.eye(4)
    for joint in chain:
        pending = pending @ _origin(joint.find("origin"), scale)
        kind = joint.get("type")
        if kind == "fixed":
            if after:
                after[-1], pending = after[-1] @ pending, np.eye(4)
            continue
        if kind not in ("revolute", "continuous") or joint.find("mimic") is not None:
            raise InputError(f"{path}: joint {joint.get('name')} is {kind}; only independent revolute joints are known")
        turn = _turn_to_z(joint.find("axis"))
        before.append(pending @ turn)
        after.append(frames.inverse(turn))
        child = joint.find("child")
        m, c = _inertia(links.get(child.get("link") if child is not None else None), scale)
        mass.append(m)
        com.append(c)
        pending = np.eye(4)
    if not before:
        raise InputError(f"{path}: no revolute joint between {base_link} and {flange_link}")
    payload = payload or {}
    return Robot(
        str(root.get("name", path.stem)), "urdf", np.array(before), np.array(after), np.zeros(len(before)),
        np.array(mass), np.array(com), float(payload.get("mass", 0.0)),
        np.array(payload.get("com", (0.0, 0.0, 0.0)), float), np.asarray(gravity, float), METRES[length_unit],
    )  # fmt: skip


def _chain(path: Path, root: Any, base_link: str | None, flange_link: str | None) -> list[Any]:
    if not base_link or not flange_link:
        raise InputError(f"{path}: robot.urdf needs base_link and flange_link in session.toml")
    parent_of = {
        joint.find("child").get("link"): joint for joint in root.iter("joint") if joint.find("child") is not None
    }
    chain, link = [], flange_link
    while link != base_link:
        if link not in parent_of:
            raise InputError(
                f"{path}: no chain from {base_link} to {flange_link} (stops at {link}); check the link names"
            )
        chain.append(parent_of[link])
        link = parent_of[link].find("parent").get("link")
    return chain[::-1]


def _origin(element: Any, scale: float) -> Array:
    if element is None:
        return np.eye(4)
    xyz, rpy = (np.array((element.get(key) or "0 0 0").split(), float) for key in ("xyz", "rpy"))
    return frames.make(Rotation.from_euler("xyz", rpy).as_matrix(), xyz * scale)


def _turn_to_z(axis: Any) -> Array:
    """A rotation whose z axis is the joint's axis; URDF's default axis is x."""
    direction = np.array((axis.get("xyz") if axis is not None else "1 0 0").split(), float)
    direction /= np.linalg.norm(direction)
    helper = np.eye(3)[np.abs(direction).argmin()]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x)
    return frames.make(np.column_stack([x, np.cross(direction, x), direction]), np.zeros(3))


def _inertia(link: Any, scale: float) -> tuple[float, Array]:
    inertial = None if link is None else link.find("inertial")
    if inertial is None or inertial.find("mass") is None:
        return 0.0, np.zeros(3)
    return float(inertial.find("mass").get("value")), _origin(inertial.find("origin"), scale)[:3, 3]


def to_urdf(robot: Robot) -> str:
    """The same chain as URDF, so that every joint angle gives the same flange pose."""
    root = ElementTree.Element("robot", name=robot.name or "robot")
    ElementTree.SubElement(root, "link", name="base_link")
    parent, carried = "base_link", np.eye(4)
    for i in range(robot.n_joints):
        origin = (
            carried
            @ robot.before[i]
            @ frames.make(Rotation.from_rotvec([0, 0, robot.theta[i]]).as_matrix(), np.zeros(3))
        )
        _add_joint(root, f"joint_{i + 1}", "continuous", parent, f"link_{i + 1}", origin, robot.metres_per_unit)
        parent, carried = f"link_{i + 1}", robot.after[i]
    _add_joint(root, "flange_joint", "fixed", parent, "flange", carried, robot.metres_per_unit)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True)


def _add_joint(root: Any, name: str, kind: str, parent: str, child: str, T: Array, metres: float) -> None:
    ElementTree.SubElement(root, "link", name=child)
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    with warnings.catch_warnings():
        # At a pitch of 90° roll and yaw are one angle: any split of it is the same rotation.
        warnings.simplefilter("ignore", UserWarning)
        rpy = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    xyz = T[:3, 3] * metres
    ElementTree.SubElement(
        joint, "origin", xyz=" ".join(repr(float(x)) for x in xyz), rpy=" ".join(repr(float(x)) for x in rpy)
    )
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    if kind != "fixed":
        ElementTree.SubElement(joint, "axis", xyz="0 0 1")
