"""Which columns of a table hold the position, the rotation or the joint angles: by name, by count, by their values."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stitch.numerics.frames import Array
from stitch.numerics.units import CLOUD_METRES
from stitch.plugins.intake.clock_times import EPOCH_S, since_1970
from stitch.plugins.intake.column_names import read_names
from stitch.plugins.intake.raw_poses import RawPoses, is_rotation
from stitch.plugins.intake.refusals import Fix, Refusal, change

# A quaternion with three digits has length 1 within this.
_UNIT_LENGTH = 5e-3
# Columns of a turntable's angle, and of joints by the words that drivers use.
_TURNTABLE = re.compile(r"turn|table|angle|winkel|dreh|theta|azimut|rotat|plate|deg|^rot$|^phi$|^c$", re.IGNORECASE)
_JOINT_WORDS = re.compile(r"joint|shoulder|elbow|wrist|axis_?\d", re.IGNORECASE)
_FEWEST_JOINTS, _TURN = 5, 2 * np.pi + 1e-3
# Larger numbers are no angles; with room for what rounding adds to a full turn.
_DEGREES = 360.5
_TIMES = re.compile(r"(?:time|time_?stamp|stamp|zeit|t|sec|seconds)(?:_(s|seconds|ms|us|µs|ns|min|h))?")
_SECONDS = {"s": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
# Names that views.csv keeps for itself.
_OWN = re.compile(r"view|cloud|time_s|[xyz]|q[xyzw]|j\d+_(deg|approach)")
# Scans are judged in millimetres.
MM = 1e-3
# Metres per unit in which people write poses.
POSE_UNITS = CLOUD_UNITS = CLOUD_METRES
# How many times farther from the origin than from each other positions of a site lie.
_SITE = 100.0
# Of the flange from the base, metres: from a desktop arm to one on a rail; in units that few robots count in, an
# arm's own.
_REACH_M = {"mm": (0.08, 12.0), "m": (0.08, 12.0), "cm": (0.25, 2.5), "inch": (0.25, 2.5)}
# Longest side of a scan, metres, and its distance from the scanner.
_SIZE_M, _RANGE_M = (5e-3, 10.0), 12.0
# Of most arms at work; motions of scans and robot that agree within this share have the same scale.
_USUAL_REACH_M, _SAME_SCALE = 0.9, 0.05


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
    sure: bool = True  # names that tell the convention cannot mean another
    turntable: bool = False  # the part turns before the scanner
    offset: tuple[float, ...] = ()  # taken off all positions, unit of the file
    rest: dict[str, Array] = field(default_factory=dict)  # other named columns (V,): times, temperatures

    @property
    def stated(self) -> dict[str, str]:
        """The option of `stitch init` that states what the words of a table without names say; none of others."""
        turn = {3: "rx,ry,rz", 4: "rot0,rot1,rot2,rot3"}.get(self.rotation.shape[1], "")
        first = "position" if self.words.startswith("columns 1 to 3 are the position") else "rotation"
        if self.named or not turn or not self.words.startswith("columns 1 "):
            return {}
        return {"columns": f"x,y,z,{turn}" if first == "position" else f"{turn},x,y,z"}

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
        found = _layout_by_name(raw) or _turntable_layout(raw)
        chosen = [] if found is None else [found]
        if found is None or not found.rotation.shape[1]:
            chosen = _layouts_among(raw) or chosen
        if chosen:
            return [_without_offset(layout) for layout in chosen]
        _require_rotation(raw)
    x, rest = _without_time(_without_index(raw.numbers))
    count = x.shape[1]
    tried = {6: _six_column_layouts, 7: _seven_column_layouts, 12: _twelve_column_layouts, 16: _sixteen_column_layouts}
    found_all = (tried[count](x) if count in tried else []) or _layouts_among(raw)
    if not found_all:
        called = "" if raw.header is None else f", called {', '.join(raw.header)},"
        words = "name each with --columns, for example --columns x,y,z,rx,ry,rz (qx,qy,qz,qw for a quaternion, j1,j2 … "
        raise Refusal(
            f"{raw.source}: {raw.numbers.shape[1]} columns of numbers{called} hold no pose that is known",
            Fix(f"{words}for joint angles, - for one to leave out)", {"columns": "COLUMNS"}, shows=raw.shown),
        )
    return [_without_offset(replace(layout, rest=rest)) for layout in found_all]


def _without_offset(layout: ColumnLayout) -> ColumnLayout:
    """The layout without what all positions have in common, where they are those of a site: eastings, northings."""
    p = layout.position
    middle = np.median(p, axis=0)
    spread = float(np.abs(p - middle).max(initial=0.0))
    if not spread or np.abs(p).max() * POSE_UNITS["mm"] < _REACH_M["mm"][1] or np.abs(p).max() < _SITE * spread:
        return layout
    step = 10.0 ** np.ceil(np.log10(spread))
    offset = np.round(middle / step) * step
    return replace(layout, position=p - offset, offset=tuple(offset.tolist()))


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
    rotation = x[:, named.rotation]
    if len(named.rotation) == 1:
        rotation = np.column_stack([np.zeros((len(x), 2)), rotation])
    return ColumnLayout(
        position=x[:, named.position] if posed else nothing,
        rotation=rotation if posed else nothing,
        joints=x[:, named.joints] if named.joints else None,
        words="columns by their names",
        convention=named.convention,
        length_unit=named.length_unit,
        angle_unit=named.angle_unit,
        named=True,
        sure=named.sure,
        rest={name: x[:, i] for name, i in named.rest.items()},
    )


def _turntable_layout(raw: RawPoses) -> ColumnLayout | None:
    """Return the angles of a turntable as turns about z; None where one column of angles does not stand alone."""
    header = raw.header or ()
    angles = [i for i, name in enumerate(header) if _TURNTABLE.search(name) and np.ptp(raw.numbers[:, i]) > 0]
    if len(angles) != 1 or read_names(header).position:
        return None
    values = raw.numbers[:, angles[0]]
    in_radians = "rad" in header[angles[0]].lower() or ("deg" not in header[angles[0]] and np.ptp(values) <= _TURN)
    half = (values if in_radians else np.radians(values)) / 2
    none = np.zeros(len(values))
    return ColumnLayout(
        position=np.zeros((len(values), 3)),
        rotation=np.column_stack([none, none, np.sin(half), np.cos(half)]),
        joints=None,
        words=f"{header[angles[0]]} is the angle of a turntable",
        convention="quaternion-xyzw",
        length_unit="mm",
        named=True,
        turntable=True,
        rest={name: raw.numbers[:, i] for i, name in enumerate(header) if i != angles[0]},
    )


def _require_rotation(raw: RawPoses) -> None:
    """Refuse columns that hold half a pose, or joint angles of no known order.

    Raises:
        InputError: with the flag that completes them, or what else is needed.
    """
    header = raw.header or ()
    if read_names(header).position and not read_names(header).rotation:
        words = "state the one that all poses have, as with --orientation 180,0,0 --rotation xyz-extrinsic"
        raise Refusal(
            f"{raw.source}: x, y, z stand there without a rotation",
            Fix(words, {"orientation": "ORIENTATION", "rotation": "ROTATION"}),
            Fix("name the columns of the rotation with --columns", {"columns": "COLUMNS"}, shows=raw.shown),
        )
    joints = [name for name in header if _JOINT_WORDS.search(name)]
    if len(joints) >= _FEWEST_JOINTS:
        raise Refusal(
            f"{raw.source}: {', '.join(joints)} are joint angles, of which the robot's URDF tells the order",
            change(raw.source, "put the URDF beside the table"),
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
    found = [layout for layout in (ahead, behind) if _is_quaternion(layout.rotation)]
    axis, angle = x[:, 3:6], x[:, 6:]
    if not found and (np.abs(np.linalg.norm(axis, axis=1) - 1) < _UNIT_LENGTH).all():
        vectors = axis * (np.radians(angle) if np.abs(angle).max() > _TURN else angle)
        words = "columns 1 to 3 are the position, 4 to 6 an axis, 7 the angle about it"
        return [replace(ahead, rotation=vectors, words=words, convention="rotation-vector", angle_unit="rad")]
    return found


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
    return [layout for layout in forms if is_rotation(layout.rotation)]


def _sixteen_column_layouts(x: Array) -> list[ColumnLayout]:
    """4×4 matrices by rows, or by columns: the row 0 0 0 1 tells."""
    T = x.reshape(-1, 4, 4)
    for words, M in (("4×4 matrices by rows", T), ("4×4 matrices by columns", T.transpose(0, 2, 1))):
        if np.allclose(M[:, 3], [0, 0, 0, 1], atol=1e-6) and is_rotation(M[:, :3, :3].reshape(-1, 9)):
            return [ColumnLayout(M[:, :3, 3], M[:, :3, :3].reshape(-1, 9), None, words, "matrix")]
    return []


def _layouts_among(raw: RawPoses) -> list[ColumnLayout]:
    """Poses among other columns, as beside a lens: a matrix, or a rotation with the position behind it or before it."""
    x = raw.numbers
    names = raw.header or tuple(map(str, range(x.shape[1])))
    for width, read in ((16, _sixteen_column_layouts), (12, _twelve_column_layouts)):
        for first in range(x.shape[1] - width + 1):
            found = [lay for lay in read(x[:, first : first + width]) if np.ptp(lay.position, axis=0).any()]
            if found and np.ptp(found[0].rotation, axis=0).any():
                where = f"columns {first + 1} to {first + width} of {x.shape[1]}"
                rest = {n: c for i, (n, c) in enumerate(zip(names, x.T, strict=True)) if not 0 <= i - first < width}
                rest = rest if raw.header else {}
                return [replace(layout, words=f"{where}: {layout.words}", rest=rest) for layout in found]
    return []


def joint_layouts(raw: RawPoses) -> list[ColumnLayout]:
    """The meaning of columns without names as joint angles."""
    nothing = np.zeros((len(raw.numbers), 0))
    if raw.numbers.shape[1] not in (6, 7):
        return []
    return [ColumnLayout(nothing, nothing, raw.numbers, "columns are joint angles")]


def covariate_columns(layout: ColumnLayout, rows: Sequence[int], time_s: Array | None = None) -> dict[str, list[str]]:
    """Cells by name, in the order of `rows`; a time that runs backwards in it and a count of the rows are left out.

    Args:
        time_s: (V,) of the clock, where the table has none in seconds.
    """
    out: dict[str, list[str]] = {}
    timed = {} if time_s is None else {"time_s": time_s}
    for name, values in (timed | layout.rest).items():
        plain = _plain_name(name)
        picked = np.asarray(values)[list(rows)]
        if timing := _TIMES.fullmatch(plain):
            if (np.diff(picked) >= 0).all():
                out["time_s"] = [f"{x:.9g}" for x in (picked - picked[0]) * _seconds_per_unit(picked, timing[1])]
        elif plain and not _is_row_count(values) and not _OWN.fullmatch(plain):
            out[plain] = [f"{x:.9g}" for x in picked]
    return out


def kept_column(name: str, columns: Mapping[str, Sequence[str]]) -> bool:
    """Whether a named column of a table is among those that `covariate_columns` returned."""
    plain = _plain_name(name)
    return plain in columns or (_TIMES.fullmatch(plain) is not None and "time_s" in columns)


def clock_column(columns: Mapping[str, Array]) -> Array | None:
    """Return the first column of times (V,) by its name, s; None where there is none that never falls."""
    for name, values in columns.items():
        timing = _TIMES.fullmatch(_plain_name(name))
        if timing and (np.diff(values) >= 0).all():
            return np.asarray(values * _seconds_per_unit(values, timing[1]))
    return None


def _plain_name(name: str) -> str:
    return re.sub(r"[^\w]+", "_", name.strip().lower()).strip("_")


def _seconds_per_unit(times: Array, unit: str | None) -> float:
    """Seconds in one unit of a column of times: as its name says, else by the size of a time since 1970."""
    if unit is not None:
        return _SECONDS[unit]
    return next((s for s in (1.0, 1e-3, 1e-6, 1e-9) if EPOCH_S[0] < times[0] * s < EPOCH_S[1]), 1.0)


def _is_row_count(values: Array) -> bool:
    """True of the numbers 0 or 1 to the last, in any order."""
    return len(values) > 2 and bool((np.diff(np.sort(values)) == 1).all()) and values.min() in (0, 1)


def pose_units(position: Array, otherwise: str = "mm") -> list[str]:
    """Units that positions (V, 3) can have, the usual first; `otherwise` if none is plausible."""
    reach = float(np.linalg.norm(position, axis=1).max(initial=0.0))
    return [u for u, m in POSE_UNITS.items() if _REACH_M[u][0] <= reach * m <= _REACH_M[u][1]] or [otherwise]


def cloud_units(clouds: Sequence[Array]) -> list[str]:
    """Units that clouds (N, 3) can have, the usual first; mm if none is plausible."""
    size, away = _scan_size(clouds)
    return [u for u in ("mm", "m") if _is_scan(size, away, u)] or ["mm"]


def unit_pairs(position: Array, clouds: Sequence[Array], factor: float) -> list[tuple[str, str]]:
    """Units of positions (V, 3) and of clouds (N, 3) that fit both their sizes, the likely pair first.

    Args:
        factor: metres per unit of the clouds over those of the positions, as motions of scans and robot say.
    """
    size, away = _scan_size(clouds)
    reach = float(np.linalg.norm(position, axis=1).max(initial=0.0))
    pairs = [
        (pose, cloud)
        for pose in pose_units(position)
        for cloud in CLOUD_UNITS
        if abs(np.log(CLOUD_UNITS[cloud] / POSE_UNITS[pose] / factor)) < _SAME_SCALE and _is_scan(size, away, cloud)
    ]
    return sorted(
        pairs,
        key=lambda pair: (
            *(u not in ("mm", "m") for u in pair),
            abs(np.log(max(reach, 1e-9) * POSE_UNITS[pair[0]] / _USUAL_REACH_M)),
        ),
    )


def _scan_size(clouds: Sequence[Array]) -> tuple[float, float]:
    """The longest side of a scan and its distance, in the middle of all."""
    size = float(np.median([np.ptp(np.percentile(c, (5, 95), axis=0), axis=0).max() for c in clouds]))
    return size, float(np.median([np.median(np.linalg.norm(c, axis=1)) for c in clouds]))


def _is_scan(size: float, away: float, unit: str) -> bool:
    metres = CLOUD_UNITS[unit]
    return _SIZE_M[0] <= size * metres <= _SIZE_M[1] and away * metres <= _RANGE_M


def size_words(clouds: Sequence[Array]) -> str:
    """How large the scans are, in the file's own numbers."""
    size, away = _scan_size(clouds)
    return f"scans are {size:.3g} long and {away:.3g} away"
