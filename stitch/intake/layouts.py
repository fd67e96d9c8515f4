"""Which columns of a table hold the position, the rotation or the joint angles: by name, by count, by their values."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.clock_times import EPOCH_S, since_1970
from stitch.intake.pose_tables import read_names
from stitch.intake.raw_poses import RawPoses
from stitch.integrity.hypotheses import ORDERS
from stitch.measurement.robot import Robot, forward
from stitch.reading.robot_description import robot_from_urdf

# A quaternion with three digits has length 1 within this.
_UNIT_LENGTH = 5e-3
_ORTHONORMAL = 1e-2
# Larger numbers are no angles; with room for what rounding adds to a full turn.
_DEGREES = 360.5


@dataclass(frozen=True)
class ColumnLayout:
    """Columns of one meaning; positions (V, 3) in the file's unit, rotations (V, k) as the file writes them."""

    position: Array  # (V, 3); (V, 0) for joint angles alone
    rotation: Array  # (V, 3) angles, (V, 4) quaternion, (V, 9) matrix by rows; (V, 0) for joint angles alone
    joints: Array | None  # (V, n) in the file's unit
    words: str
    convention: str | None = None  # where names or values tell it
    length_unit: str | None = None
    angle_unit: str | None = None
    named: bool = False  # the file names its columns
    rest: dict[str, Array] = field(default_factory=dict)  # other named columns (V,): times, temperatures

    @property
    def angles(self) -> Array:
        """Numbers that are angles: of the rotation, else of the joints."""
        return self.rotation if self.rotation.shape[1] == 3 or self.joints is None else self.joints


def possible_layouts(raw: RawPoses) -> list[ColumnLayout]:
    """Every meaning that the columns can have, the usual first.

    Raises:
        InputError: columns that hold no pose, with the flag that names them.
    """
    if raw.header is not None:
        found = _layout_by_name(raw)
        if found is not None:
            return [found]
    x, rest = _without_time(_without_index(raw.numbers))
    count = x.shape[1]
    tried = {6: _six_column_layouts, 7: _seven_column_layouts, 12: _twelve_column_layouts, 16: _sixteen_column_layouts}
    found_all = tried[count](x) if count in tried else []
    if not found_all:
        called = "" if raw.header is None else f", called {', '.join(raw.header)},"
        raise InputError(
            f"{raw.source}: {raw.numbers.shape[1]} columns of numbers{called} "
            "hold no pose that is known; to fix: name each with --columns, for example --columns x,y,z,rx,ry,rz "
            "(qx,qy,qz,qw for a quaternion, j1,j2 … for joint angles, - for one to leave out)"
        )
    return [replace(layout, rest=rest) for layout in found_all]


def _layout_by_name(raw: RawPoses) -> ColumnLayout | None:
    named = read_names(raw.header or ())
    x = raw.numbers
    if len(named.rotation) in (12, 16):
        matrices = (_sixteen_column_layouts if len(named.rotation) == 16 else _twelve_column_layouts)(
            x[:, named.rotation]
        )
        rest = {name: x[:, i] for name, i in named.rest.items()}
        return replace(matrices[0], rest=rest) if matrices else None
    posed = bool(named.position and named.rotation)
    if not posed and not named.joints:
        return None
    nothing = np.zeros((len(x), 0))
    return ColumnLayout(
        position=x[:, named.position] if posed else nothing,
        rotation=x[:, named.rotation] if posed else nothing,
        joints=x[:, named.joints] if named.joints else None,
        words="columns by their names",
        convention=named.convention,
        length_unit=named.length_unit,
        angle_unit=named.angle_unit,
        named=True,
        rest={name: x[:, i] for name, i in named.rest.items()},
    )


def _without_index(x: Array) -> Array:
    """The table without a first column that counts its rows."""
    counts = len(x) > 2 and x.shape[1] in (7, 8, 13, 17) and bool((np.diff(x[:, 0]) == 1).all())
    return x[:, 1:] if counts and x[0, 0] in (0, 1) else x


def _without_time(x: Array) -> tuple[Array, dict[str, Array]]:
    """The table without a first column of times since 1970, and that column by its name."""
    timed = x.shape[1] in (7, 8, 13, 17) and len(x) > 1 and since_1970(x[:, 0]) is not None
    return (x[:, 1:], {"time": x[:, 0]}) if timed else (x, {})


def _six_column_layouts(x: Array) -> list[ColumnLayout]:
    """A position and three angles, either first: both where both can be angles in degrees, as small positions can."""
    first, last = x[:, :3], x[:, 3:]
    ahead = ColumnLayout(first, last, None, "columns 1 to 3 are the position, 4 to 6 the angles")
    behind = ColumnLayout(last, first, None, "columns 1 to 3 are the angles, 4 to 6 the position")
    return [layout for layout in (ahead, behind) if np.abs(layout.rotation).max() <= _DEGREES]


def _seven_column_layouts(x: Array) -> list[ColumnLayout]:
    ahead = ColumnLayout(x[:, :3], x[:, 3:], None, "columns 1 to 3 are the position, 4 to 7 the quaternion")
    behind = ColumnLayout(x[:, 4:], x[:, :4], None, "columns 1 to 4 are the quaternion, 5 to 7 the position")
    return [layout for layout in (ahead, behind) if _is_quaternion(layout.rotation)]


def _is_quaternion(q: Array) -> bool:
    return bool((np.abs(np.linalg.norm(q, axis=1) - 1) < _UNIT_LENGTH).all())


def _twelve_column_layouts(x: Array) -> list[ColumnLayout]:
    """3×4 matrices by rows, or a rotation by rows and the position behind it or before it."""
    rows = x.reshape(-1, 3, 4)
    forms = (
        ColumnLayout(rows[:, :, 3], rows[:, :, :3].reshape(-1, 9), None, "3×4 matrices by rows", "matrix"),
        ColumnLayout(x[:, 9:], x[:, :9], None, "columns 1 to 9 are the rotation, 10 to 12 the position"),
        ColumnLayout(x[:, :3], x[:, 3:], None, "columns 1 to 3 are the position, 4 to 12 the rotation"),
    )
    return [layout for layout in forms if _is_rotation(layout.rotation)]


def _sixteen_column_layouts(x: Array) -> list[ColumnLayout]:
    """4×4 matrices by rows, or by columns: the row 0 0 0 1 tells."""
    T = x.reshape(-1, 4, 4)
    for words, M in (("4×4 matrices by rows", T), ("4×4 matrices by columns", T.transpose(0, 2, 1))):
        if np.allclose(M[:, 3], [0, 0, 0, 1], atol=1e-6) and _is_rotation(M[:, :3, :3].reshape(-1, 9)):
            return [ColumnLayout(M[:, :3, 3], M[:, :3, :3].reshape(-1, 9), None, words, "matrix")]
    return []


def _is_rotation(rows: Array) -> bool:
    R = rows.reshape(-1, 3, 3)
    return bool(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < _ORTHONORMAL and (np.linalg.det(R) > 0).all())


# Columns beside the poses, times and temperatures, as views.csv names them.

_TIMES = re.compile(r"(?:time|timestamp|stamp|zeit|t|sec|seconds)(?:_(s|ms|us|µs|ns|min|h))?")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
# Names that views.csv keeps for itself.
_OWN = re.compile(r"view|cloud|time_s|[xyz]|q[xyzw]|j\d+_(deg|approach)")


def covariate_columns(layout: ColumnLayout, rows: Sequence[int], time_s: Array | None = None) -> dict[str, list[str]]:
    """Cells by name, in the order of `rows`; a time that runs backwards in it and a count of the rows are left out.

    Args:
        time_s: (V,) of the clock, where the table has none in seconds.
    """
    out: dict[str, list[str]] = {}
    timed = {} if time_s is None else {"time_s": time_s}
    for name, values in (timed | layout.rest).items():
        plain = re.sub(r"[^\w]+", "_", name.strip().lower()).strip("_")
        picked = np.asarray(values)[list(rows)]
        if timing := _TIMES.fullmatch(plain):
            if (np.diff(picked) >= 0).all():
                out["time_s"] = [f"{x:.9g}" for x in (picked - picked[0]) * _seconds_per_unit(picked, timing[1])]
        elif plain and not _is_row_count(values) and not _OWN.fullmatch(plain):
            out[plain] = [f"{x:.9g}" for x in picked]
    return out


def _seconds_per_unit(times: Array, unit: str | None) -> float:
    """Seconds in one unit of a column of times: as its name says, else by the size of a time since 1970."""
    if unit is not None:
        return _SECONDS[unit]
    return next((s for s in (1.0, 1e-3, 1e-6, 1e-9) if EPOCH_S[0] < times[0] * s < EPOCH_S[1]), 1.0)


def _is_row_count(values: Array) -> bool:
    """True of the numbers 0 or 1 to the last, in any order."""
    return len(values) > 2 and bool((np.diff(np.sort(values)) == 1).all()) and values.min() in (0, 1)


# Between which links of a URDF the arm lies: the root, and what people call the flange.

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


# Every way to read the rotations of a table, each with the words that name it.
#
# Orders of Euler angles: twelve, about axes that turn along (intrinsic) or that stand still (extrinsic); Diebel (2006),
# "Representing Attitude". `zyx-intrinsic` turns by the first number about z, by the second about the new y.

# The usual ones first: roll, pitch, yaw (FANUC, ROS, Yaskawa); A, B, C (KUKA); the others as they come.
_USUAL = ("xyz-extrinsic", "zyx-intrinsic", "xyz-intrinsic", "rotation-vector", "zyz-intrinsic")
_BY_AXIS = ("XZY", "YXZ", "YZX", "ZXY")
# Larger numbers are degrees; a rotation vector and Euler angles in radians stay below.
_RADIANS = 2 * np.pi + 1e-3


@dataclass(frozen=True)
class Reading:
    """The poses of a table read in one way."""

    T: Array  # (V, 4, 4) lengths as the file has them
    rotation: str  # as --rotation names it
    angle_unit: str | None  # "deg" or "rad" where there are angles
    layout: ColumnLayout
    rank: int  # of the usual, 0 first

    @property
    def words(self) -> str:
        """As a person says it."""
        return self.rotation + (f", {'degrees' if self.angle_unit == 'deg' else 'radians'}" if self.angle_unit else "")


def rotation_conventions() -> list[str]:
    """Every word that --rotation knows."""
    angles = [*_euler_words(), *(f"{o.lower()}-by-axis" for o in _BY_AXIS), "rotation-vector"]
    return [*angles, "quaternion-xyzw", "quaternion-wxyz", "matrix", "matrix-transposed"]


def _euler_words() -> list[str]:
    return [f"{order.lower()}-{how}" for order in ORDERS for how in ("intrinsic", "extrinsic")]


def readings(layout: ColumnLayout, rotation: str | None = None, angle_unit: str | None = None) -> list[Reading]:
    """All readings of a layout that has a pose, the usual first; one where file or flags tell it.

    Args:
        rotation: one of `conventions()`, where a person says it.
        angle_unit: "deg" or "rad", likewise.

    Raises:
        InputError: a convention that these columns cannot have.
    """
    stated = rotation or layout.convention
    kinds = {3: _angle_readings, 4: _quaternion_readings, 9: _matrix_readings}
    numbers = layout.rotation.shape[1]
    found = list(kinds[numbers](layout, angle_unit or layout.angle_unit))
    if stated is not None:
        known = ", ".join(dict.fromkeys(r.rotation for r in found))
        found = [r for r in found if r.rotation == stated]
        if not found:
            raise InputError(f"--rotation {stated}: the rotation has {numbers} numbers; to fix: use one of {known}")
    return sorted(found, key=lambda r: r.rank)


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
    if layout.convention == "quaternion-wxyz" or layout.convention is None:
        yield _rotation_reading(layout, Rotation.from_quat(q[:, [1, 2, 3, 0]]), "quaternion-wxyz", None, 1)


def _matrix_readings(layout: ColumnLayout, _: str | None) -> Iterator[Reading]:
    R = layout.rotation.reshape(-1, 3, 3)
    yield _rotation_reading(layout, Rotation.from_matrix(R), "matrix", None, 0)
    if layout.convention is None:
        yield _rotation_reading(layout, Rotation.from_matrix(R.transpose(0, 2, 1)), "matrix-transposed", None, 1)


def _rotation_reading(layout: ColumnLayout, R: Rotation, word: str, unit: str | None, rank: int) -> Reading:
    return Reading(frames.make(R.as_matrix(), layout.position), word, unit, layout, rank)


# Joint angles as poses, where a URDF lies beside them.

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


# Which units lengths can have, by what robots reach and scanners see.

# Scans are judged in millimetres.
MM = 1e-3
# Metres per unit in which people write poses.
POSE_UNITS = {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "inch": 0.0254}
CLOUD_UNITS = {"mm": 1e-3, "m": 1.0}
# Of the flange from the base, metres: from a desktop arm to one on a rail; in units that few robots count in, an
# arm's own.
_REACH_M = {"mm": (0.08, 12.0), "m": (0.08, 12.0), "cm": (0.25, 2.5), "inch": (0.25, 2.5)}
# Longest side of a scan, metres, and its distance from the scanner.
_SIZE_M, _RANGE_M = (5e-3, 10.0), 12.0


def pose_units(position: Array) -> list[str]:
    """Units that positions (V, 3) can have, the usual first; mm if none is plausible."""
    reach = float(np.linalg.norm(position, axis=1).max(initial=0.0))
    return [u for u, m in POSE_UNITS.items() if _REACH_M[u][0] <= reach * m <= _REACH_M[u][1]] or ["mm"]


def cloud_units(clouds: Sequence[Array]) -> list[str]:
    """Units that clouds (N, 3) can have, the usual first; mm if none is plausible."""
    size = float(np.median([np.ptp(np.percentile(c, (5, 95), axis=0), axis=0).max() for c in clouds]))
    away = float(np.median([np.median(np.linalg.norm(c, axis=1)) for c in clouds]))
    fits = [u for u, m in CLOUD_UNITS.items() if _SIZE_M[0] <= size * m <= _SIZE_M[1] and away * m <= _RANGE_M]
    return fits or ["mm"]


def size_words(clouds: Sequence[Array]) -> str:
    """How large the scans are, in the file's own numbers."""
    size = float(np.median([np.ptp(np.percentile(c, (5, 95), axis=0), axis=0).max() for c in clouds]))
    away = float(np.median([np.median(np.linalg.norm(c, axis=1)) for c in clouds]))
    return f"scans are {size:.3g} long and {away:.3g} away"
