"""What the names of columns say: position, rotation, joint angles, units."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

# Words that say nothing about which number a column holds.
_FILLERS = {"pose", "tcp", "robot", "flange", "tool", "tool0", "actual", "target", "base", "in", "of", "the", "coord"}
_FILLERS |= {"lage", "koordinate", "verschiebung", "roboter", "flansch", "achse", "um", "ist", "soll", "wert"}
_FILLERS |= {"position", "pos", "translation", "trans", "t", "p", "transform", "vector", "point", "cartesian", "end"}
_ROTATION = {"rotation", "orientation", "quaternion", "quat", "rot", "euler", "angles", "angle", "rpy", "rotvec", "o"}
_ROTATION |= {"drehung", "winkel", "orientierung"}
_LENGTHS = {"mm": "mm", "millimeter": "mm", "millimetre": "mm", "m": "m", "meter": "m", "metre": "m", "cm": "cm"}
_LENGTHS |= {"inch": "inch", "in": "inch", "inches": "inch"}
_ANGLES = {"deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "rad": "rad", "radian": "rad", "radians": "rad"}
# In German degrees, elsewhere a four-hundredth of a turn: the unit of an angle, whichever.
_ANGULAR = {*_ANGLES, "grad"}
_UNIT = re.compile(r"[\[(]\s*([^\])]*)\s*[\])]|[_\s](mm|cm|deg|rad|inch|°|grad|(?<=\s)m)$", re.IGNORECASE)
# The one angle of a SCARA, or of a vehicle: a turn about z.
_HEADING = re.compile(r"(?:u|a|c|w|r|rz|rot_?z|yaw|heading|theta|phi)(?:[ _]*[\[(]?(?:deg|rad|°)[\])]?)?")
_COUNTED = re.compile(r".*tcp_?pose[_\[. ]*([0-6])\]?")
_JOINT = re.compile(r"(?:j|joint|axis|theta|jt)_?([1-9])")
# Triples of angles and quadruples of quaternions by name; a rotation stated by its names alone, or None.
_NAMED = {
    ("qx", "qy", "qz", "qw"): "quaternion-xyzw",
    ("q0", "q1", "q2", "q3"): "quaternion-wxyz",
    ("q1", "q2", "q3", "q4"): "quaternion-wxyz",
    ("rotx", "roty", "rotz", "rotw"): "quaternion-xyzw",
    ("rvx", "rvy", "rvz"): "rotation-vector",
    ("azyx", "bzyx", "czyx"): "zyx-intrinsic",
    ("ozyz", "azyz", "tzyz"): "zyz-intrinsic",
    ("w", "p", "r"): "xyz-extrinsic",
    ("roll", "pitch", "yaw"): "xyz-extrinsic",
    ("yaw", "pitch", "roll"): "zyx-intrinsic",
    ("omega", "phi", "kappa"): "xyz-intrinsic",
    ("rx", "ry", "rz"): None,
    ("rz", "ry", "rx"): None,
    ("a", "b", "c"): None,
    ("u", "v", "w"): None,
    ("alpha", "beta", "gamma"): None,
    ("rotx", "roty", "rotz"): None,
    ("rotz", "roty", "rotx"): None,
    ("rot0", "rot1", "rot2"): None,
    ("rot0", "rot1", "rot2", "rot3"): None,
}
# Names under which nobody writes anything else; q0 … q3 have been x, y, z, w, and roll, pitch, yaw KUKA's A, B, C.
_SURE = [{"qx", "qy", "qz", "qw"}, {"rvx", "rvy", "rvz"}, {"azyx", "bzyx", "czyx"}, {"ozyz", "azyz", "tzyz"}]


@dataclass(frozen=True)
class NamedColumns:
    """Columns whose meaning their names tell; indices into the columns."""

    position: tuple[int, ...] = ()
    rotation: tuple[int, ...] = ()
    joints: tuple[int, ...] = ()
    convention: str | None = None  # of the rotation, where the names alone tell it
    sure: bool = True  # nobody writes another convention under these names
    length_unit: str | None = None  # of the position
    angle_unit: str | None = None  # of rotation or joints
    rest: dict[str, int] = field(default_factory=dict)  # other named columns: times, temperatures


def read_names(header: Sequence[str]) -> NamedColumns:
    """What a header says."""
    plain, units = zip(*(bare_name(name) for name in header), strict=True)
    where: dict[str, int] = {}
    for i, name in enumerate(plain):
        where.setdefault(name, i)
    joints = _joint_columns(header)
    counted = _counted_pose(header)
    if counted:
        called = dict(zip(counted, ("x", "y", "z", "rvx", "rvy", "rvz"), strict=True))
        plain = tuple(called.get(i, name) for i, name in enumerate(plain))
        units = tuple("m" if i in counted[:3] else unit for i, unit in enumerate(units))
        where = {name: plain.index(name) for name in plain}
    position = tuple(where[a] for a in "xyz") if all(a in where for a in "xyz") else ()
    rotation, convention = _rotation_columns(where, set(position) | set(joints))
    if position and not rotation:
        heading = tuple(i for i, name in enumerate(header) if _HEADING.fullmatch(name.strip().lower()))
        rotation, convention = (heading, "rotation-vector") if len(heading) == 1 else ((), None)
    matrix = _matrix_columns(header) if not rotation else ()
    if matrix:
        rotation, position, convention = matrix, (), None
    used = {*position, *rotation, *joints}
    return NamedColumns(
        position=position,
        rotation=rotation,
        joints=joints,
        convention=convention,
        sure=convention is None or len(rotation) == 1 or {plain[i] for i in rotation} in _SURE,
        length_unit=next((_LENGTHS[units[i]] for i in position if units[i] in _LENGTHS), None),
        angle_unit=next((_ANGLES[units[i]] for i in (*rotation, *joints) if units[i] in _ANGLES), None),
        rest={header[i]: i for i in range(len(header)) if i not in used and header[i] not in ("", "-")},
    )


def is_unit(text: str) -> bool:
    """Whether a text is the unit of a length or of an angle."""
    word = text.strip("[]() ").lower()
    return word in _LENGTHS or word in _ANGULAR


def bare_name(name: str) -> tuple[str, str]:
    """A name without its unit and fillers, and its unit."""
    found = _UNIT.search(name.strip())
    unit = (found[1] or found[2] or "").strip().lower() if found else ""
    if found:
        name = name.strip()[: found.start()]
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)  # camelCase
    words = [w for w in re.split(r"[._\s/\-]+", name.lower()) if w]
    unit = unit or next((w for w in words if w in ("mm", "deg", "rad", "cm", "inch")), "")
    if not unit and "m" in words and len(words) > 1:
        unit = "m"
    turned = any(w in _ROTATION for w in words)
    words = [w for w in words if w != unit]
    kept = [w for w in words if w not in _FILLERS and w not in _ROTATION and w not in ("xyzw", "wxyz", "xyz")]
    if not kept:
        return (words[-1] if len(words) == 1 else ""), unit
    last = re.sub(r"^(?:[pt]|pos)_?([xyz])$", r"\1", kept[-1])
    if kept[0] == "q" and last in ("w", "x", "y", "z"):
        return f"q{last}", unit
    order = next((w for w in words if w in ("xyzw", "wxyz")), None)
    if order and last in ("0", "1", "2", "3"):
        return f"q{order[int(last)]}", unit
    if last in ("0", "1", "2") and not turned and any(w in words for w in ("position", "pos", "translation", "t")):
        return "xyz"[int(last)], unit
    # An axis with the unit of an angle is a turn, in whatever language it is named: "Drehung um Z [°]".
    turned = turned if last in ("w", "0", "1", "2", "3") else last in ("x", "y", "z") and (turned or unit in _ANGULAR)
    return (f"rot{last}" if turned else last), unit


def _counted_pose(header: Sequence[str]) -> tuple[int, ...]:
    """Return the columns actual_TCP_pose_0 … 5 in their order, as RTDE of Universal Robots records them; else none."""
    for kind in ("actual", "target", ""):
        found = [
            (int(m[1]), i) for i, n in enumerate(header) if (m := _COUNTED.fullmatch(n.lower())) and kind in n.lower()
        ]
        if len(found) == 6 and len({number for number, _ in found}) == 6:
            return tuple(i for _, i in sorted(found))
    return ()


def _rotation_columns(where: dict[str, int], taken: set[int]) -> tuple[tuple[int, ...], str | None]:
    for names, convention in sorted(_NAMED.items(), key=lambda item: -len(item[0])):
        index = [where.get(name, -1) for name in names]
        # Angles by place: the triple counts in the order in which its columns stand.
        ordered = len(names) == 4 or index == sorted(index)
        if min(index) >= 0 and not taken & {*index} and ordered:
            return tuple(index), convention
    return (), None


def _joint_columns(header: Sequence[str]) -> tuple[int, ...]:
    alike: dict[str, dict[int, int]] = {}
    for i, name in enumerate(header):
        lower = name.strip().lower()
        match = _JOINT.match(lower) or re.match(r"(?:.*joints?|.*_q|q|a)[._\s\[]*(\d)\b", lower)
        if match:
            alike.setdefault(lower[: match.start(1)], {}).setdefault(int(match[1]), i)
    for found in alike.values():
        first, count = min(found), len(found)
        complete = count >= 4 and sorted(found) == list(range(first, first + count))
        if complete and (count >= 5 or "j" in header[found[first]].lower()):
            return tuple(found[k] for k in sorted(found))
    return ()


def _matrix_columns(header: Sequence[str]) -> tuple[int, ...]:
    """Columns m00 … m33, r11 … t3 or 0 … 15 in the order of the file, if they are 12 or 16."""
    named = [
        i for i, name in enumerate(header) if re.search(r"(?:^|[._])(?:[mtr]?_?\d{1,2}|t[xyz1-3])\]?$", name.lower())
    ]
    return tuple(named) if len(named) in (12, 16) else ()
