"""Robots from URDF. URDF counts in metres and radians (http://wiki.ros.org/urdf/XML)."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.robot import Robot
from stitch.reading.dh_rows import gravity_of, payload_of
from stitch.reading.text_file import require_file
from stitch.reading.urdf_elements import Element, attribute_numbers, fixed_links, link_name, origin
from stitch.reading.urdf_meshes import link_meshes
from stitch.units import METRES


def robot_from_urdf(
    path: Path | str,
    base_link: str | None,
    flange_link: str | None,
    length_unit: str,
    gravity: Array,
    payload: dict[str, Any] | None = None,
) -> Robot:
    """The serial chain base_link → flange_link, in length_unit.

    Fixed joints are merged. A link's mass includes all links fixed to it, a tool beyond the flange too:
    `payload` comes on top. Links on moving side branches (fingers) are not counted.

    Raises:
        InputError: unreadable, no such link, no chain between them, or a joint that does not turn freely.
    """
    path = Path(path)
    require_file(path, "correct robot.urdf in session.toml")
    try:
        robot = ElementTree.parse(path).getroot()
    except (OSError, ValueError, LookupError, ElementTree.ParseError) as error:
        raise InputError(f"{path}: not a readable URDF: {error}; to fix: export it as plain URDF") from None
    try:
        scale, chain = 1 / METRES[length_unit], _joint_chain(robot, base_link, flange_link)
        before, after, mass, com, T_last_flange = _serial_chain(robot, chain, scale)
        payload_mass, payload_com = payload_of(payload)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return Robot(
        name=str(robot.get("name", path.stem)),
        convention="urdf",
        before=before,
        after=after,
        theta=np.zeros(len(before)),
        mass=mass,
        com=com,
        payload_mass=payload_mass,
        payload_com=payload_com,
        gravity=gravity_of(gravity),
        metres_per_unit=METRES[length_unit],
        meshes=link_meshes(robot, chain, path.parent, scale, frames.inverse(T_last_flange)),
    )


def _serial_chain(root: Element, chain: list[Element], scale: float) -> tuple[Array, Array, Array, Array, Array]:
    """What stands before and behind the turn of every joint (n, 4, 4), what it moves: mass (n,), com (n, 3).

    And T_last_flange (4, 4): the flange's frame in that of the last link.
    """
    before: list[Array] = []
    after: list[Array] = []
    mass, com = [], []
    pending = np.eye(4)
    for joint in chain:
        pending = pending @ origin(joint, scale)
        if joint.get("type") == "fixed":
            continue
        _require_turning(joint)
        turn = _turn_to_z(joint)
        before.append(pending @ turn)
        after.append(frames.inverse(turn))
        body = list(_rigid_body(root, link_name(joint, "child"), scale))
        mass.append(sum(m for m, _ in body))
        com.append(sum((m * c for m, c in body), np.zeros(3)) / (mass[-1] or 1.0))
        pending = np.eye(4)
    if not before:
        raise InputError("no revolute joint between base_link and flange_link; to fix: name the ends of the arm")
    # The last link's own frame is the flange: what is fixed to it moves the frame and the centre of mass.
    after[-1] = after[-1] @ pending
    com[-1] = frames.transform(frames.inverse(pending), com[-1][None])[0]
    return np.array(before), np.array(after), np.array(mass), np.array(com), pending


def _joint_chain(root: Element, base_link: str | None, flange_link: str | None) -> list[Element]:
    """Joints from base to flange; walked backwards, because a link has one parent."""
    parent_of: dict[str, Element] = {}
    for joint in root.findall("joint"):
        child = link_name(joint, "child")
        if child in parent_of:
            raise InputError(f"link {child} hangs on two joints; a URDF is a tree")
        parent_of[child] = joint
    if not base_link or not flange_link:
        parents = {link_name(joint, "parent") for joint in parent_of.values()}
        roots, ends = (", ".join(sorted(names)) for names in (parents - set(parent_of), set(parent_of) - parents))
        raise InputError(
            "robot.urdf needs base_link and flange_link in session.toml; the tree starts at "
            f"{roots or '?'} and ends at {ends}"
        )
    chain: list[Element] = []
    link = flange_link
    while link != base_link:
        if link not in parent_of or parent_of[link] in chain:
            raise InputError(f"no chain from {base_link} to {flange_link} (stops at {link}); check the link names")
        chain.append(parent_of[link])
        link = link_name(chain[-1], "parent")
    return chain[::-1]


def _require_turning(joint: Element) -> None:
    name, kind = joint.get("name"), joint.get("type")
    if kind not in ("revolute", "continuous"):
        raise InputError(f"joint {name} is {kind}; only revolute and continuous joints are known")
    if joint.find("mimic") is not None:
        raise InputError(f"joint {name} copies another joint (mimic); only independent revolute joints are known")


def _rigid_body(root: Element, link: str, scale: float) -> Iterator[tuple[float, Array]]:
    """Mass and centre of mass (in the frame of `link`) of it and of every link fixed to it."""
    for element, T in fixed_links(root, link, scale):
        name, inertial = element.get("name"), element.find("inertial")
        if inertial is not None and inertial.find("mass") is not None:
            mass = attribute_numbers(inertial.find("mass"), "value", "0", f"link {name}")
            if len(mass) != 1 or mass[0] < 0:
                raise InputError(f"link {name}: mass is not a positive number")
            yield float(mass[0]), (T @ origin(inertial, scale, f"link {name}"))[:3, 3]


def _turn_to_z(joint: Element) -> Array:
    """A rotation whose z axis is the joint's axis; URDF's default axis is x."""
    direction = attribute_numbers(joint.find("axis"), "xyz", "1 0 0", f"axis of joint {joint.get('name')}")
    length = np.linalg.norm(direction)
    if length < 1e-9:
        raise InputError(f"axis of joint {joint.get('name')} has no direction; to fix: write its axis")
    direction /= length
    helper = np.eye(3)[np.abs(direction).argmin()]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x)
    return frames.make(np.column_stack([x, np.cross(direction, x), direction]), np.zeros(3))
