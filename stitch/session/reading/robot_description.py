"""Robots from DH rows of the [robot] table, and from URDF; what is stated is checked.

A wrong number would move the arm without a word. URDF counts in metres and radians (http://wiki.ros.org/urdf/XML).
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.session.reading.text_files import require_file, require_known_keys, shortened
from stitch.session.robot import LinkMesh, Robot, elementary

Element = ElementTree.Element
# No length, angle or mass of an arm is larger in any unit; beyond, squares overflow.
LARGEST = 1e12
_DH_KEYS = ("a", "alpha_deg", "d", "theta_deg", "mass", "com")
_MOVING = ("revolute", "continuous", "prismatic")


def robot_from_dh(
    name: str,
    convention: str,
    joints: Sequence[dict[str, Any]],
    payload: dict[str, Any] | None,
    gravity: Array,
    length_unit: str,
) -> Robot:
    """Return a robot from Denavit–Hartenberg rows.

    Args:
        name: of the robot.
        convention: standard | modified.
        joints: one row a joint with keys a, alpha_deg, d, theta_deg, mass, com; missing ones are 0.
        payload: table with mass, kg, and com, flange frame; None: no payload.
        gravity: (3,) m/s², base frame.
        length_unit: of a, d and com: a key of METRES.

    Raises:
        InputError: unknown convention or key, no row, or a value that is not a finite number.
    """
    if not isinstance(joints, list) or not joints:
        raise InputError("robot.joints is no list of rows; write one DH row a joint")
    rows = [(f"robot.joints, joint {i + 1}", row) for i, row in enumerate(joints)]
    for where, row in rows:
        require_known_keys(where, row, _DH_KEYS)

    def column(key: str) -> Array:
        """Return the numbers (n,) that the rows state under a key."""
        return np.array([float(table_numbers(where, row, key, ())) for where, row in rows])

    a = column("a")
    alpha = np.radians(column("alpha_deg"))
    d = column("d")
    theta = np.radians(column("theta_deg"))
    before, after = _joint_transforms(convention, a, alpha, d)
    masses = [_point_mass(where, row) for where, row in rows]
    payload_mass, payload_com = _payload_of(payload)
    return Robot(
        name=name,
        convention=convention,
        before=before,
        after=after,
        theta=theta,
        mass=np.array([m for m, _ in masses]),
        com=np.array([c for _, c in masses]),
        payload_mass=payload_mass,
        payload_com=payload_com,
        gravity=table_numbers("robot", {"gravity": gravity}, "gravity", (3,)),
        metres_per_unit=METRES[length_unit],
        a=a,
        alpha=alpha,
        d=d,
    )


def _joint_transforms(convention: str, a: Array, alpha: Array, d: Array) -> tuple[Array, Array]:
    """Return the constant transforms (n, 4, 4) before and after the rotation of each joint: before · Rz(q) · after.

    Args:
        convention: standard | modified.
        a, alpha, d: (n,) length_unit, rad, length_unit.
    """
    if convention == "standard":
        return np.broadcast_to(np.eye(4), (len(a), 4, 4)), elementary("z", 0, d) @ elementary("x", alpha, a)
    if convention == "modified":
        return elementary("x", alpha, a), elementary("z", 0, d)
    raise InputError(f'robot.dh is {convention!r}; use "standard" or "modified"')


def _payload_of(payload: dict[str, Any] | None) -> tuple[float, Array]:
    """Return mass (kg) and centre of mass (3,) in the flange frame of [robot] payload; both 0 without one."""
    if payload is None:
        return 0.0, np.zeros(3)
    require_known_keys("robot.payload", payload, ("mass", "com"))
    return _point_mass("robot.payload", payload)


def _point_mass(where: str, table: dict[str, Any]) -> tuple[float, Array]:
    """Return mass, kg, not negative, and centre of mass `com` (3,), length_unit, of a table; 0 where absent."""
    mass = float(table_numbers(where, table, "mass", ()))
    if mass < 0:
        raise InputError(f"{where}: mass is {mass:g} kg; use a positive number")
    return mass, table_numbers(where, table, "com", (3,))


def table_numbers(where: str, table: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
    """Return the finite number, shape (), or three numbers, shape (3,), at `key` of a table; 0 where absent.

    Args:
        where: names the table in the message.

    Raises:
        InputError: another shape, or a number that is not finite or above `LARGEST`.
    """
    try:
        value = np.array(table.get(key, np.zeros(shape)), float)
    except (TypeError, ValueError, OverflowError):
        value = np.full(shape, np.nan)
    if value.shape != shape or not (np.abs(value) < LARGEST).all():
        kind = "three finite numbers" if shape else "a finite number"
        raise InputError(f"{where}: {key} is {shortened(table[key])}; use {kind}")
    return value


def robot_from_urdf(
    path: Path | str,
    base_link: str | None,
    flange_link: str | None,
    length_unit: str,
    gravity: Array,
    payload: dict[str, Any] | None = None,
) -> Robot:
    """Return the serial chain from base_link to flange_link of a URDF as a robot, in length_unit.

    Fixed joints are merged. A link's mass includes all links fixed to it, also a tool beyond the flange; `payload` is
    added to that. Links on moving side branches (fingers) are not counted.

    Args:
        base_link, flange_link: names of links; None is refused, with the names that could be meant.
        gravity: (3,) m/s², base frame.
        payload: table with mass, kg, and com, length_unit in the flange frame; None: no payload.

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
        scale = 1 / METRES[length_unit]
        joints = _joint_chain(robot, base_link, flange_link)
        before, after, mass, com, T_last_flange = _serial_chain(robot, joints, scale)
        payload_mass, payload_com = _payload_of(payload)
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
        gravity=table_numbers("robot", {"gravity": gravity}, "gravity", (3,)),
        metres_per_unit=METRES[length_unit],
        meshes=_link_meshes(robot, joints, path.parent, scale, frames.inverse(T_last_flange)),
    )


def _serial_chain(root: Element, chain: list[Element], scale: float) -> tuple[Array, Array, Array, Array, Array]:
    """Return the n revolute joints of a chain, T_base_flange = Π before[i] · Rz(q_i) · after[i], fixed joints merged.

    Args:
        root: of the document, in which the links' masses are looked up.
        chain: joints from base to flange, fixed ones among them.
        scale: length_unit per metre.

    Returns:
        before and after (n, 4, 4), length_unit; the mass (n,), kg, of the link that joint i moves, with all that is
        fixed to it; its centre of mass (n, 3) in the frame behind after[i], the link's own, of the last one the
        flange's; and T_last_flange (4, 4), from the flange to the last link's frame of the URDF.

    Raises:
        InputError: no revolute joint, or a joint of another kind.
    """
    before: list[Array] = []
    after: list[Array] = []
    mass: list[float] = []
    com: list[Array] = []
    pending = np.eye(4)  # product of the transforms since the last revolute joint
    for joint in chain:
        pending = pending @ _origin(joint, scale)
        if joint.get("type") == "fixed":
            continue
        _require_turning(joint)
        turn = _turn_to_z(joint)
        before.append(pending @ turn)
        after.append(frames.inverse(turn))
        body = list(_rigid_body(root, _link_name(joint, "child"), scale))
        mass.append(sum(m for m, _ in body))
        com.append(sum((m * c for m, c in body), np.zeros(3)) / (mass[-1] or 1.0))
        pending = np.eye(4)
    if not before:
        raise InputError("no revolute joint between base_link and flange_link; to fix: name the ends of the arm")
    # Fixed joints behind the last revolute one lead to the flange: `after` ends there, `com` is given in its frame.
    after[-1] = after[-1] @ pending
    com[-1] = frames.transform(frames.inverse(pending), com[-1][None])[0]
    return np.array(before), np.array(after), np.array(mass), np.array(com), pending


def _joint_chain(root: Element, base_link: str | None, flange_link: str | None) -> list[Element]:
    """Return the joints from base to flange, in this order, fixed ones among them.

    The tree is walked from the flange, because a link has one parent and many children.

    Raises:
        InputError: a link is not named, there is no chain between them, or a link has two parents.
    """
    parent_of: dict[str, Element] = {}
    for joint in root.findall("joint"):
        child = _link_name(joint, "child")
        if child in parent_of:
            raise InputError(f"link {child} hangs on two joints; a URDF is a tree")
        parent_of[child] = joint
    if not base_link or not flange_link:
        parents = {_link_name(joint, "parent") for joint in parent_of.values()}
        roots = ", ".join(sorted(parents - set(parent_of)))
        ends = ", ".join(sorted(set(parent_of) - parents))
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
        link = _link_name(chain[-1], "parent")
    return chain[::-1]


def _require_turning(joint: Element) -> None:
    """Refuse a joint that is not revolute, or that copies another joint.

    Raises:
        InputError: names the joint and its kind.
    """
    name, kind = joint.get("name"), joint.get("type")
    if kind not in ("revolute", "continuous"):
        raise InputError(f"joint {name} is {kind}; only revolute and continuous joints are known")
    if joint.find("mimic") is not None:
        raise InputError(f"joint {name} copies another joint (mimic); only independent revolute joints are known")


def _rigid_body(root: Element, link: str, scale: float) -> Iterator[tuple[float, Array]]:
    """Yield mass, kg, and centre of mass (3,), in the frame of `link`, of that link and of every link fixed to it.

    Args:
        scale: length_unit per metre; centres are in length_unit.

    Raises:
        InputError: a mass that is negative or no number.
    """
    for element, T in _fixed_links(root, link, scale):
        name, inertial = element.get("name"), element.find("inertial")
        if inertial is not None and inertial.find("mass") is not None:
            mass = _attribute_numbers(inertial.find("mass"), "value", "0", f"link {name}")
            if len(mass) != 1 or mass[0] < 0:
                raise InputError(f"link {name}: mass is not a positive number")
            yield float(mass[0]), (T @ _origin(inertial, scale, f"link {name}"))[:3, 3]


def _turn_to_z(joint: Element) -> Array:
    """Return a rotation (4, 4) whose z axis is the axis of a joint, in the joint's frame; URDF's default axis is x.

    Raises:
        InputError: the axis is zero or no number.
    """
    direction = _attribute_numbers(joint.find("axis"), "xyz", "1 0 0", f"axis of joint {joint.get('name')}")
    length = np.linalg.norm(direction)
    if length < 1e-9:
        raise InputError(f"axis of joint {joint.get('name')} has no direction; to fix: write its axis")
    direction /= length
    helper = np.eye(3)[np.abs(direction).argmin()]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x)
    return frames.make(np.column_stack([x, np.cross(direction, x), direction]), np.zeros(3))


def moving_joints(urdf: str, base_link: str, flange_link: str) -> list[tuple[str, str]]:
    """Return (name, kind) of each moving joint between two links of a URDF's text, from the base on.

    Empty where the text cannot be read or has no chain between them.
    """
    try:
        chain = _joint_chain(ElementTree.fromstring(urdf), base_link, flange_link)
    except (ValueError, LookupError, ElementTree.ParseError, InputError):
        return []
    return [(j.get("name") or "", str(j.get("type"))) for j in chain if j.get("type") in _MOVING]


def poses_of_urdf(urdf: str, base_link: str, flange_link: str, joints: Array) -> Array:
    """Return T_base_flange (V, 4, 4), mm, of a URDF's text at V sets of joint values.

    Args:
        base_link, flange_link: names of the links at the ends of the chain.
        joints: (V, n) of the moving joints from the base on: rad, of prismatic ones m.
    """
    T = np.tile(np.eye(4), (len(joints), 1, 1))
    values = iter(joints.T)
    for joint in _joint_chain(ElementTree.fromstring(urdf), base_link, flange_link):
        T = T @ _origin(joint, 1e3)
        if joint.get("type") in _MOVING:
            turn = _turn_to_z(joint)
            q = next(values)
            motion = elementary("z", 0.0, 1e3 * q) if joint.get("type") == "prismatic" else elementary("z", q)
            T = T @ turn @ motion @ frames.inverse(turn)
    return T


def _link_meshes(
    root: Element, chain: list[Element], folder: Path, scale: float, T_flange_last: Array
) -> tuple[LinkMesh, ...]:
    """Return the meshes that <visual> elements name, of the links of a chain and of what is fixed to them.

    What has no file, or no numbers where it stands, is left out: a picture is no reason to refuse an arm.

    Args:
        chain: joints from base to flange, fixed ones among them.
        folder: of the URDF; names begin there, those of a package wherever above it the rest of the name fits.
        scale: length_unit per metre.
        T_flange_last: (4, 4) frame of the last turning joint's link in that of the flange.
    """
    turning = [joint for joint in chain if joint.get("type") != "fixed"]
    links = [_link_name(chain[0], "parent"), *(_link_name(joint, "child") for joint in turning)]
    meshes = []
    for i, link in enumerate(links):
        T_frame_link = T_flange_last if i == len(turning) else np.eye(4)
        for element, T in _fixed_links(root, link, scale):
            for visual in element.findall("visual"):
                mesh = _mesh(visual, folder, scale)
                if mesh is not None:
                    T_link_mesh, file, mesh_scale = mesh
                    meshes.append(LinkMesh(i, T_frame_link @ T @ T_link_mesh, file, mesh_scale))
    return tuple(meshes)


def _mesh(visual: Element, folder: Path, scale: float) -> tuple[Array, Path, Array] | None:
    """Return T_link_mesh (4, 4) of a <visual>, its file, and its scale (3,), length_unit per unit of the file.

    None where it has no mesh, no file or no numbers.

    Args:
        folder: of the URDF.
        scale: length_unit per metre.
    """
    mesh = visual.find("geometry/mesh")
    file = None if mesh is None else _file(mesh.get("filename") or "", folder)
    if file is None:
        return None
    try:
        return _origin(visual, scale, "visual"), file, _attribute_numbers(mesh, "scale", "1 1 1", "visual") * scale
    except InputError:
        return None


def _file(name: str, folder: Path) -> Path | None:
    """Return the existing file that a URDF names; None if there is none.

    Plain paths and file:// begin at `folder`, the URDF's. Of package://NAME/REST, NAME/REST or REST is looked for in
    that folder and in all above it.
    """
    kind, mark, rest = name.rpartition("://")
    if not rest or (mark and kind not in ("file", "package")):
        return None
    places = [folder / rest]
    if kind == "package":
        inside = rest.partition("/")[2]
        places = [above / path for above in (folder, *folder.resolve().parents) for path in (rest, inside) if path]
    try:
        return next((place for place in places if place.is_file()), None)
    except (OSError, ValueError):
        return None


def _fixed_links(root: Element, link: str, scale: float) -> Iterator[tuple[Element, Array]]:
    """Yield (link, T) for a link and every link fixed to it: T (4, 4) maps its frame to that of the first.

    Args:
        link: name of the first.
        scale: length_unit per metre.
    """
    waiting = [(link, np.eye(4))]
    while waiting:
        name, T = waiting.pop()
        element = next((e for e in root.findall("link") if e.get("name") == name), None)
        if element is not None:
            yield element, T
        for joint in root.findall("joint"):
            if joint.get("type") == "fixed" and _link_name(joint, "parent") == name:
                waiting.append((_link_name(joint, "child"), T @ _origin(joint, scale)))


def _link_name(joint: Element, kind: str) -> str:
    """Return the name of the link at the `parent` or `child` end of a joint.

    Raises:
        InputError: it names none.
    """
    element = joint.find(kind)
    if element is None or not element.get("link"):
        raise InputError(f"joint {joint.get('name')} has no <{kind} link=…>; to fix: write it")
    return str(element.get("link"))


def _origin(owner: Element, scale: float, where: str = "") -> Array:
    """Return the transform (4, 4) of the <origin> of an element; the identity where it has none.

    Args:
        scale: factor on its lengths: length_unit per metre.
        where: names the element in a message; empty: as a joint.

    Raises:
        InputError: something that is no number.
    """
    from scipy.spatial.transform import Rotation

    where = where or f"joint {owner.get('name')}"
    element = owner.find("origin")
    xyz = _attribute_numbers(element, "xyz", "0 0 0", where)
    rpy = _attribute_numbers(element, "rpy", "0 0 0", where)
    return frames.make(Rotation.from_euler("xyz", rpy).as_matrix(), xyz * scale)


def _attribute_numbers(element: Element | None, key: str, default: str, where: str) -> Array:
    """Return the numbers (n,) of an attribute, as many as the text `default` has, which counts where it is absent.

    Raises:
        InputError: other than so many finite numbers.
    """
    text = default if element is None else element.get(key) or default
    try:
        numbers = np.array(text.split(), float)
    except ValueError:
        numbers = np.array([np.nan])
    if len(numbers) != len(default.split()) or not (np.abs(numbers) < LARGEST).all():
        raise InputError(f"{where}: {key} is {text!r}, not numbers; expand xacro files first")
    return numbers
