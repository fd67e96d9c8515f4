"""Elements of a URDF: numbers, origins, ends of joints, what is fixed to a link."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.reading.dh_rows import LARGEST

Element = ElementTree.Element


def link_name(joint: Element, kind: str) -> str:
    """Name of the link at the `parent` or `child` end of a joint.

    Raises:
        InputError: it names none.
    """
    element = joint.find(kind)
    if element is None or not element.get("link"):
        raise InputError(f"joint {joint.get('name')} has no <{kind} link=…>; to fix: write it")
    return str(element.get("link"))


def fixed_links(root: Element, link: str, scale: float) -> Iterator[tuple[Element, Array]]:
    """A link and every link fixed to it, and where each stands in the frame of the first (4, 4)."""
    waiting = [(link, np.eye(4))]
    while waiting:
        name, T = waiting.pop()
        element = next((e for e in root.findall("link") if e.get("name") == name), None)
        if element is not None:
            yield element, T
        for joint in root.findall("joint"):
            if joint.get("type") == "fixed" and link_name(joint, "parent") == name:
                waiting.append((link_name(joint, "child"), T @ origin(joint, scale)))


def origin(owner: Element, scale: float, where: str = "") -> Array:
    """(4, 4) of the <origin> of an element, lengths times `scale`; unity where it has none.

    Raises:
        InputError: something that is no number.
    """
    where = where or f"joint {owner.get('name')}"
    element = owner.find("origin")
    xyz, rpy = (attribute_numbers(element, key, "0 0 0", where) for key in ("xyz", "rpy"))
    return frames.make(Rotation.from_euler("xyz", rpy).as_matrix(), xyz * scale)


def attribute_numbers(element: Element | None, key: str, default: str, where: str) -> Array:
    """(n,) the numbers of an attribute, as many as its default has.

    Raises:
        InputError: other than so many finite numbers.
    """
    text = default if element is None else element.get(key) or default
    try:
        found = np.array(text.split(), float)
    except ValueError:
        found = np.array([np.nan])
    if len(found) != len(default.split()) or not (np.abs(found) < LARGEST).all():
        raise InputError(f"{where}: {key} is {text!r}, not numbers; expand xacro files first")
    return found
