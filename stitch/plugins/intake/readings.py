"""Every way to read the poses of a table: orders of rotations, units, and joint angles by the robot's URDF.

Orders of Euler angles: twelve, about axes that turn along (intrinsic) or that stand still (extrinsic); Diebel (2006),
"Representing Attitude". `zyx-intrinsic` turns by the first number about z, by the second about the new y. The arm of a
URDF lies between its root and what people call the flange.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.intake.layouts import POSE_UNITS, ColumnLayout, joint_layouts, pose_units, possible_layouts
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.refusals import Fix, Refusal, change
from stitch.screening.hypotheses import ORDERS
from stitch.session.reading.robot_description import moving_joints, poses_of_urdf
from stitch.session.robot import Robot, forward

# The usual ones first: roll, pitch, yaw (FANUC, ROS, Yaskawa); A, B, C (KUKA); the others as they come.
_USUAL = ("xyz-extrinsic", "zyx-intrinsic", "xyz-intrinsic", "rotation-vector", "zyz-intrinsic")
_BY_AXIS = ("XZY", "YXZ", "YZX", "ZXY")
# Larger numbers are degrees; a rotation vector and Euler angles in radians stay below.
_RADIANS = 2 * np.pi + 1e-3
# Readings of an unknown order that are tried with every linear axis; columns that can be one, and that are none.
_USUAL_AXIS = 5
_NO_AXIS = re.compile(
    r"temp|grad|speed|vel|force|torque|current|volt|count|index|time|stamp|sec|nr|\b(no|id)\b|°", re.I
)
# Steps of poses and of the arm in the joints beside them turn alike within this, rad.
_TURNS_ALIKE = 5e-3
JOINT_ANGLES, _SLIDING = "joint angles", "joints that turn and slide"
_SLID_MM = 20.0  # longer ways of a slide are no metres
# tool0 and flange are those of ROS-Industrial.
_FLANGES = ("tool0", "flange", "ee_link", "tcp")


@dataclass(frozen=True)
class StatedTable:
    """How a table of poses is to be read, checked."""

    columns: tuple[str, ...] = ()
    rotation: str | None = None
    angle_unit: str | None = None
    length_unit: str | None = None  # of the poses
    inverse: bool | None = None  # the table holds T_flange_base

    def __post_init__(self) -> None:
        """Refuse words that mean nothing.

        Raises:
            InputError: names the flag and what it knows.
        """
        require_known_word("--rotation", self.rotation, rotation_conventions())
        require_known_word("--angles", self.angle_unit, ("deg", "rad"))
        require_known_word("--unit, --file-unit", self.length_unit, POSE_UNITS)


def require_known_word(flag: str, value: str | None, known: Collection[str]) -> None:
    """Refuse a word that a flag does not know."""
    if value is not None and value not in known:
        name = flag.split(",")[0].strip("-").replace("-", "_")
        raise Refusal(f"{flag} {value}:", Fix(f"use {', '.join(known)}", {name: name.upper()}))


@dataclass(frozen=True)
class Reading:
    """The poses of a table read in one way."""

    T: Array  # (V, 4, 4) lengths as the file has them
    rotation: str  # as --rotation names it
    angle_unit: str | None  # "deg" or "rad" where there are angles
    layout: ColumnLayout
    rank: int  # of the usual, 0 first
    variant: str = ""  # what else was done to the numbers: an axis added, a joint uncoupled
    axis: tuple[str, int, float] | None = None  # column added to x, y or z (0, 1, 2), and with which sign

    @property
    def stated(self) -> dict[str, str]:
        """Options of `stitch init` that state it."""
        return {"rotation": self.rotation} | ({"angles": self.angle_unit} if self.angle_unit else {})

    @property
    def words(self) -> str:
        """As a person says it."""
        unit = f", {'degrees' if self.angle_unit == 'deg' else 'radians'}" if self.angle_unit else ""
        return f"{self.rotation}{unit}{f', {self.variant}' if self.variant else ''}"


def rotation_conventions() -> list[str]:
    """Every word that --rotation knows."""
    angles = [*_euler_words(), *(f"{o.lower()}-by-axis" for o in _BY_AXIS), "rotation-vector"]
    return [*angles, "quaternion-xyzw", "quaternion-wxyz", "matrix", "matrix-transposed"]


def _euler_words() -> list[str]:
    return [f"{order.lower()}-{how}" for order in ORDERS for how in ("intrinsic", "extrinsic")]


def readings(layout: ColumnLayout, rotation: str | None = None, angle_unit: str | None = None) -> list[Reading]:
    """Return all readings of a layout that has a pose, the usual first; one where file or flags tell it.

    Args:
        rotation: one of `conventions()`, where a person says it.
        angle_unit: "deg" or "rad", likewise.

    Raises:
        InputError: a convention that these columns cannot have.
    """
    found = _rotation_readings(layout, angle_unit)
    stated = rotation or layout.convention
    if stated is not None:
        known = ", ".join(dict.fromkeys(r.rotation for r in found))
        found = [r for r in found if r.rotation == stated]
        if not found:
            numbers = layout.rotation.shape[1]
            told = f"--rotation {stated}: the rotation has {numbers} numbers"
            raise Refusal(told, Fix(f"use one of {known}", {"rotation": "ROTATION"}))
    return found


def _rotation_readings(layout: ColumnLayout, angle_unit: str | None) -> list[Reading]:
    """Return all readings, whatever the names of the columns say, the usual first."""
    kinds = {3: _angle_readings, 4: _quaternion_readings, 9: _matrix_readings}
    return sorted(kinds[layout.rotation.shape[1]](layout, angle_unit or layout.angle_unit), key=lambda r: r.rank)


def angle_units(values: Array, stated: str | None) -> list[str]:
    """Units that angles (V, k) can have: degrees where they exceed a turn in radians, else both, radians first."""
    if stated is not None:
        return [stated]
    return ["deg"] if np.abs(values).max(initial=0.0) > _RADIANS else ["rad", "deg"]


def _angle_readings(layout: ColumnLayout, stated: str | None) -> Iterator[Reading]:
    for place, unit in enumerate(angle_units(layout.rotation, stated)):
        angles = np.radians(layout.rotation) if unit == "deg" else layout.rotation
        for word, R in _rotations(angles):
            rank = _USUAL.index(word) if word in _USUAL else len(_USUAL)
            yield _rotation_reading(layout, R, word, unit, rank + 100 * place)


def _rotations(angles: Array) -> Iterator[tuple[str, Rotation]]:
    for word in _euler_words():
        order, how = word.split("-")
        yield word, Rotation.from_euler(order.upper() if how == "intrinsic" else order, angles)
    for order in _BY_AXIS:
        # Columns name the axes x, y, z; the turns come in another order than the columns stand.
        columns = ["XYZ".index(axis) for axis in order]
        yield f"{order.lower()}-by-axis", Rotation.from_euler(order, angles[:, columns])
    yield "rotation-vector", Rotation.from_rotvec(angles)


def _quaternion_readings(layout: ColumnLayout, _: str | None) -> Iterator[Reading]:
    q = layout.rotation / np.linalg.norm(layout.rotation, axis=1, keepdims=True)
    yield _rotation_reading(layout, Rotation.from_quat(q), "quaternion-xyzw", None, 0)
    yield _rotation_reading(layout, Rotation.from_quat(q[:, [1, 2, 3, 0]]), "quaternion-wxyz", None, 1)


def _matrix_readings(layout: ColumnLayout, _: str | None) -> Iterator[Reading]:
    R = layout.rotation.reshape(-1, 3, 3)
    yield _rotation_reading(layout, Rotation.from_matrix(R), "matrix", None, 0)
    if layout.convention is None:
        yield _rotation_reading(layout, Rotation.from_matrix(R.transpose(0, 2, 1)), "matrix-transposed", None, 1)


def _rotation_reading(layout: ColumnLayout, R: Rotation, word: str, unit: str | None, rank: int) -> Reading:
    return Reading(frames.make(R.as_matrix(), layout.position), word, unit, layout, rank)


def all_readings(raw: RawPoses, arm: Path | Robot | None, stated: StatedTable) -> list[Reading]:
    """Every reading of a table that is not ruled out by what a person states.

    Args:
        arm: URDF of the robot, or the arm in mm, where the table may hold joint angles.

    Raises:
        InputError: columns that hold no pose.
    """
    out: list[Reading] = []
    for layout in possible_layouts(raw):
        if layout.rotation.shape[1]:
            out += readings(layout, stated.rotation, stated.angle_unit)
        else:
            out += joint_readings(layout, arm, stated.angle_unit)
    if raw.header is None and raw.numbers.shape[1] >= 6 and isinstance(arm, Path) and stated.rotation is None:
        out += [r for layout in joint_layouts(raw) for r in joint_readings(layout, arm, stated.angle_unit)]
    return out


def doubted_readings(raw: RawPoses, urdf: Path | None, stated: StatedTable) -> list[Reading]:
    """Return readings against the names of the columns, or with a linear axis or a coupled joint taken into account.

    They count where the scans contradict every reading of `all_readings`.
    """
    out: list[Reading] = []
    for layout in possible_layouts(raw):
        if layout.rotation.shape[1]:
            believed = readings(layout, stated.rotation, stated.angle_unit)
            against = [] if stated.rotation else _rotation_readings(layout, stated.angle_unit)
            known = {reading.rotation for reading in believed}
            out += [reading for reading in against if reading.rotation not in known]
            out += _on_a_linear_axis(believed[:_USUAL_AXIS])
        elif layout.joints is not None and urdf is not None:
            out += _uncoupled(layout, urdf, stated.angle_unit)
    return out


def mixed_readings(raw: RawPoses, stated: StatedTable) -> Iterator[Reading]:
    """Yield angles of which one column is in radians and the others are in degrees, where their sizes allow that.

    They count where the scans tell no other reading.
    """
    for layout in possible_layouts(raw) if stated.angle_unit is None else ():
        size = np.abs(layout.rotation).max(axis=0, initial=0.0)
        for k in np.flatnonzero(size <= _RADIANS) if len(size) == 3 and size.max() > _RADIANS else ():
            rotation = np.array(layout.rotation)
            rotation[:, k] = np.degrees(rotation[:, k])
            for reading in readings(replace(layout, rotation=rotation), stated.rotation, "deg"):
                yield replace(reading, variant=f"but its {('first', 'second', 'third')[k]} angle in radians")


def left_handed_readings(raw: RawPoses, stated: StatedTable) -> Iterator[Reading]:
    """Yield angles that count the other way round, all of them or the one about the vertical, as headings do.

    They count where the scans tell no other reading.
    """
    for layout in possible_layouts(raw):
        for turned, words in ((-1.0, "but all its angles"), (np.array([1.0, 1.0, -1.0]), "but its third angle")):
            if layout.rotation.shape[1] == 3:
                for reading in readings(
                    replace(layout, rotation=turned * layout.rotation), stated.rotation, stated.angle_unit
                ):
                    yield replace(reading, variant=f"{words} counted the other way round")


def _on_a_linear_axis(found: Sequence[Reading]) -> Iterator[Reading]:
    """Yield poses with a column beside them added to x, y or z: a rail that carries the robot."""
    for reading in found:
        columns = {n: v for n, v in reading.layout.rest.items() if np.ptp(v) > 0 and not _NO_AXIS.search(n)}
        for name, values in list(columns.items())[:3]:
            for axis, sign in ((a, s) for a in range(3) for s in (1.0, -1.0)):
                T = np.array(reading.T)
                T[:, axis, 3] += sign * values
                words = f"{name} added {'to' if sign > 0 else 'with the other sign to'} {'xyz'[axis]} as a linear axis"
                yield replace(reading, T=T, variant=words, axis=(name, axis, sign))


def _uncoupled(layout: ColumnLayout, urdf: Path, angle_unit: str | None) -> Iterator[Reading]:
    """Yield poses of joints of which the third is shown as it moves with the second: FANUC, parallelograms."""
    assert layout.joints is not None
    if layout.joints.shape[1] < 3:
        return
    for sign, words in ((1.0, "j3 is j3 + j2, as FANUC shows it"), (-1.0, "j3 is j3 - j2, as of a parallelogram")):
        joints = np.array(layout.joints)
        joints[:, 2] += sign * joints[:, 1]
        for reading in joint_readings(replace(layout, joints=joints), urdf, angle_unit):
            yield replace(reading, variant=words)


def with_uncoupled_joints(reading: Reading, urdf: Path | None) -> Reading:
    """Return a reading of poses whose joints, beside them, count as the robot's description does: they turn as it."""
    layout = reading.layout
    if urdf is None or layout.joints is None or not layout.rotation.shape[1]:
        return reading
    try:
        ways = [*joint_readings(layout, urdf, None), *_uncoupled(layout, urdf, None)]
    except InputError:
        return reading  # joints of another arm
    turned, *others = (frames.angle_between(T[:-1], T[1:]) for T in (reading.T, *(way.T for way in ways)))
    off = [float(np.abs(other - turned).max()) for other in others]
    best = ways[int(np.argmin(off))]
    if min(off) > _TURNS_ALIKE or not best.variant:
        return reading
    words = f"{layout.words}; {best.variant}: only so the arm turns as the poses beside say"
    return replace(reading, layout=replace(layout, joints=best.layout.joints, words=words))


def candidate_units(readings: Sequence[Reading], stated: StatedTable, otherwise: str = "mm") -> list[str]:
    """Units that positions can have of which the file does not say it: stated, or plausible; else that of the clouds.

    Positions near the origin, as of a turntable or of scans that are registered already, are plausible in none.
    """
    if stated.length_unit:
        return [stated.length_unit]
    open_ = [r for r in readings if r.layout.length_unit is None]
    return list(dict.fromkeys(unit for r in open_ for unit in pose_units(r.T[:, :3, 3], otherwise))) or ["mm"]


def joint_readings(layout: ColumnLayout, arm: Path | Robot | None, angle_unit: str | None) -> list[Reading]:
    """Poses of joint angles, mm, in every unit that the angles can have.

    Args:
        arm: its URDF, or the arm in mm.

    Raises:
        InputError: no URDF beside them, or one of another number of joints.
    """
    joints = layout.joints
    assert joints is not None
    if arm is None:
        words = "put the URDF into the folder, or give poses; with DH rows write session.toml by hand"
        raise Refusal("joint angles need the robot", change(".", words))
    if isinstance(arm, Robot):
        kinds = [(f"j{i}", "revolute") for i in range(1, arm.n_joints + 1)]
        poses: Callable[[Array], Array] = partial(forward, arm)
    else:
        text = arm.read_text(encoding="utf-8", errors="replace")
        base, flange = arm_links(arm, joints.shape[1])
        kinds = moving_joints(text, base, flange)
        poses = partial(poses_of_urdf, text, base, flange)
    if len(kinds) != joints.shape[1]:
        told = f"{arm.name}: has {len(kinds)} joints, the table {joints.shape[1]}"
        raise Refusal(told, Fix("name the columns with --columns", {"columns": "COLUMNS"}))
    slides = np.array([kind == "prismatic" for _, kind in kinds])
    in_m = np.abs(joints[:, slides]).max(initial=0.0) <= _SLID_MM
    layout, word = replace(layout, length_unit="mm"), JOINT_ANGLES
    if slides.any():
        # Effects of joints are for arms that turn, so that the joints stay beside the poses as columns.
        units = np.where(slides, "_m" if in_m else "_mm", "")
        columns = {f"{name}{unit}": q for (name, _), unit, q in zip(kinds, units, joints.T, strict=True)}
        layout, word = replace(layout, joints=None, rest=columns | layout.rest), _SLIDING
    out = []
    for place, unit in enumerate(angle_units(joints[:, ~slides], angle_unit or layout.angle_unit)):
        scale = np.where(slides, 1.0 if in_m else 1e-3, 1.0 if unit == "rad" else np.pi / 180)
        out.append(Reading(poses(joints * scale), word, unit, layout, 100 * place))
    return out


def with_joints_of(raw: RawPoses, urdf: Path) -> RawPoses:
    """Return a table whose columns bear the names of a robot's joints with j1, j2 … in the arm's order."""
    text = urdf.read_text(encoding="utf-8", errors="replace")
    for base, flange in arm_link_pairs(text):
        names = [name for name, _ in moving_joints(text, base, flange)]
        where = [_column_of_joint(name, raw.header or ()) for name in names]
        if names and None not in where and len(set(where)) == len(where):
            order = {column: f"j{i}" for i, column in enumerate(where, 1)}
            header = [
                f"{order[i]} [rad]" if i in order and "rad" in name.lower().split("_")[-1] else order.get(i, name)
                for i, name in enumerate(raw.header or ())
            ]
            words = f"{raw.words}; joints {', '.join(names)} by the names of {urdf.name}"
            return replace(raw, header=tuple(header), words=words)
    return raw


def _column_of_joint(joint: str, header: Sequence[str]) -> int | None:
    """Return the one column that a joint's name stands in, speeds and efforts left aside."""
    found = [
        i
        for i, name in enumerate(header)
        if re.search(rf"(?<![a-z0-9]){re.escape(joint.lower())}(?![a-z0-9])", re.sub(r"[_.\[\]/]", "_", name.lower()))
        and not re.search(r"vel|eff|torque|current", name.lower().replace(joint.lower(), ""))
    ]
    return found[0] if len(found) == 1 else None


def arm_links(urdf: Path, joints: int) -> tuple[str, str]:
    """Return root and flange of the arm between which so many joints lie.

    Raises:
        InputError: unreadable, or no chain of so many joints.
    """
    text = urdf.read_text(encoding="utf-8", errors="replace")
    told = "not a readable URDF; to fix: export it as plain URDF"
    for base, flange in arm_link_pairs(text):
        count = len(moving_joints(text, base, flange))
        if count == joints:
            return base, flange
        told = f"has {count} joints, the table {joints}; to fix: name the columns (--columns)"
    raise InputError(f"{urdf}: {told}")


def arm_link_pairs(urdf: str) -> list[tuple[str, str]]:
    """Root and flange of a URDF's text by name, else root and the child of each turning joint, the last first."""
    try:
        root = ElementTree.fromstring(urdf)
    except (ValueError, LookupError, ElementTree.ParseError):
        return []
    links = [str(link.get("name")) for link in root.findall("link")]
    ends = [(j.get("type"), getattr(j.find("child"), "attrib", {}).get("link")) for j in root.findall("joint")]
    children = {child for _, child in ends}
    base = next((name for name in links if name not in children), None)
    turned = [str(child) for kind, child in ends if kind in ("revolute", "continuous")]
    flanges = [name for name in _FLANGES if name in links] + turned[::-1]
    return [] if base is None else [(base, flange) for flange in flanges]
