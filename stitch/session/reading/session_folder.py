"""A session folder on disk -> `Session`; every check of input is made here or in the readers it calls."""

import csv
import hashlib
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.session.capture import MAX_POINTS, distinct_points, points_within, thin_cloud
from stitch.session.moving_scanner import stand_still
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.robot_description import require_known_keys, robot_from_dh, robot_from_urdf, table_numbers
from stitch.session.reading.session_tables import ViewRow, read_frames, read_points, read_targets, read_views, row_at
from stitch.session.reading.text_files import (
    optional_text,
    read_toml,
    readable,
    require_file,
    require_folder_name,
    require_name,
    shortened,
    table_choice,
)
from stitch.session.robot import Robot
from stitch.session.session import (
    Cloud,
    Mount,
    NominalTargets,
    Scanner,
    SensorKind,
    SessionData,
    Sighting,
    StatedRepeatability,
    View,
)
from stitch.system.threads import parallel

# Are all clouds of a session in one unit? A few of another one are wrong by themselves, not by the session's unit.

_LISTED_CLOUDS = 4


def is_plausible_size(size_m: float, limits: tuple[float, float]) -> bool:
    """Whether a size, m, can be; 0 says nothing."""
    return limits[0] <= size_m <= limits[1] or size_m == 0


def length_message(size_m: float) -> str:
    """A length for a message."""
    return f"{size_m * 1e3:.3g} mm" if size_m < 1 else f"{size_m:.3g} m"


def require_one_unit(
    toml: Path, sizes: Mapping[str, float], limits: tuple[float, float], does: str, cloud_unit: str
) -> None:
    """Refuse a few clouds whose size only makes sense in another unit than that of the others.

    Args:
        sizes: by view, m.
        does: what a cloud does over that size, with {} in its place.

    Raises:
        InputError: names the views, and how to fix it.
    """
    odd = {name: size for name, size in sizes.items() if not is_plausible_size(size, limits)}
    others = [size for name, size in sizes.items() if name not in odd]
    if not odd or len(odd) > len(others):
        return
    one = len(odd) == 1
    names = ", ".join([*odd][:_LISTED_CLOUDS]) + " …" * (len(odd) > _LISTED_CLOUDS)
    size, usual = (length_message(float(np.median(found))) for found in ([*odd.values()], others))
    raise InputError(
        f"{toml}: the points of view{'' if one else 's'} {names} {does.format(size)}, those of the others (usually) "
        f'{usual}, with cloud_unit = "{cloud_unit}": {"that cloud alone is" if one else "those clouds are"} in another '
        f"unit than the others; to fix: export {'it' if one else 'them'} again in {cloud_unit}"
    )


# Is the scale right? Metres read as millimetres, or the reverse, are off by 1000.
#
# Sizes and motions are judged, and how far things can lie; not how near: the origin of many structured-light and line
# scanners lies in the middle of what they measure.

# What one scan of a robot's scanner shows, in metres: from a borescope to a hull.
_SIZE_M = (3e-3, 20.0)
# How far the middle of a scan may lie from the sensor's origin, and any single point.
_RANGE_M, _FARTHEST_M = 20.0, 1000.0
# Trackers see as far as a hall is long.
_SIGHT_M = 100.0
# Reach of robots, in metres.
_REACH_M = (0.03, 60.0)
# A target moves about as far as the flange: not a few hundred times more or less.
_MOTION_RATIO = 300.0
# Fields of view over the working distance; a 1000 times less or more is another unit.
_FIELD_SIZE = (2e-3, 30.0)
_OTHER_UNIT = {"mm": "m", "m": "mm"}


def check_scale(session: SessionData, cloud_unit: str) -> None:
    """Refuse clouds or poses whose size only makes sense in the other unit.

    Raises:
        InputError: names the quantity, its size and the key to change.
    """
    metres = METRES[session.length_unit]
    toml = session.path / "session.toml"
    own = session.length_unit
    clouds = [(view.name, view.cloud) for view in session.views if view.cloud is not None]
    away = {name: metres * _median_distance(cloud.points) for name, cloud in clouds}
    over = {name: metres * _trimmed_extent(cloud.points) for name, cloud in clouds}
    for sizes, limits, does, how in ((away, (0.0, _RANGE_M), "lie", "away"), (over, _SIZE_M, "extend over", "")):
        require_one_unit(toml, sizes, limits, f"{does} {{}}{' ' * bool(how)}{how}", cloud_unit)
        for name, size in sizes.items():
            _refuse(size, limits, f"{toml}: the points of view {name} {does}", how, "cloud_unit", cloud_unit)
    for view in session.views:
        if view.sighting is not None:
            distance = _median_distance(view.sighting.points) * metres
            what = f"{toml}: the targets of view {view.name} lie"
            _refuse(distance, (0.0, _SIGHT_M), what, "away", "length_unit", own)
    flange = np.array([view.T_base_flange[:3, 3] for view in session.views]) * metres
    reach = float(np.linalg.norm(flange, axis=1).max())
    _refuse(reach, _REACH_M, f"{toml}: the flange stands at most", "away", "length_unit", own)
    _compare_motions(session, flange)
    _compare_standoff(session, cloud_unit)


def _median_distance(points: Array) -> float:
    return float(np.median(np.linalg.norm(points, axis=1)))


def _trimmed_extent(points: Array) -> float:
    """The longest side of the box around all but the outermost points."""
    low, high = np.percentile(points, (5, 95), axis=0)
    return float((high - low).max())


def require_near(what: str, points: Array) -> None:
    """Refuse single points (N, 3), m, that no sensor measures: one of them would stretch every grid over the cloud."""
    if np.abs(points).max() > _FARTHEST_M:
        far = np.abs(points).max(axis=1) > _FARTHEST_M
        raise InputError(
            f"{what}: {far.sum()} of {len(points)} points lie more than {_FARTHEST_M:g} m from the scanner, the first "
            f"is point {int(far.argmax()) + 1}; to fix: remove them from the cloud, or check cloud_unit"
        )


def _refuse(size_m: float, limits: tuple[float, float], what: str, how: str, key: str, unit: str) -> None:
    if is_plausible_size(size_m, limits):
        return
    shown = length_message(size_m)
    hint = f'the scale looks off by 1000: set {key} = "{_OTHER_UNIT[unit]}"'
    raise InputError(f'{what} {shown}{" " * bool(how)}{how} with {key} = "{unit}"; {hint}')


def _compare_motions(session: SessionData, flange: Array) -> None:
    """Labelled points have no size of their own, but a target that several views see moves with the arm."""
    seen = [view.sighting for view in session.views if view.sighting is not None]
    if len(seen) < 3 or session.has_clouds:
        return
    names = np.concatenate([sighting.targets for sighting in seen])
    points = np.concatenate([sighting.points for sighting in seen]) * METRES[session.length_unit]
    moved, arm = max(_extent(points[names == name]) for name in np.unique(names)), _extent(flange)
    # A target that one view sees has not moved at all.
    if min(moved, arm) > 0 and not 1 / _MOTION_RATIO < moved / arm < _MOTION_RATIO:
        raise InputError(
            f"{session.path / 'session.toml'}: the targets move over {moved * 1e3:.3g} mm, the flange over "
            f"{arm * 1e3:.3g} mm; the scale looks off by 1000: write poses and targets in length_unit "
            f'(is "{session.length_unit}")'
        )


def _extent(points: Array) -> float:
    """The longest side of the box around points."""
    return float(np.ptp(points, axis=0).max())


def _compare_standoff(session: SessionData, cloud_unit: str) -> None:
    """Against the working distance that the session itself states."""
    clouds = [view.cloud.points for view in session.views if view.cloud is not None]
    if not clouds or not session.scanner.standoff:
        return
    size = float(np.median([_trimmed_extent(points) for points in clouds]))
    distance = float(np.median([_median_distance(points) for points in clouds]))
    low, high = _FIELD_SIZE
    if size < low * session.scanner.standoff or max(size, distance) > high * session.scanner.standoff:
        raise InputError(
            f"{session.path / 'session.toml'}: points lie {distance:.3g} {session.length_unit} away over "
            f"{size:.3g}, but scanner.standoff is {session.scanner.standoff:.3g}; "
            f'the scale looks off by 1000: check cloud_unit (is "{cloud_unit}")'
        )


# session.toml: every key checked, tables turned to what they describe.

SESSION_FORMAT = "stitch-session/1"

_KEYS = {
    "": {"format", "name", "length_unit", "cloud_unit", "mount", "scanner", "robot", "sphere", "part"},
    "scanner": {"pose", "noise", "standoff", "optical_axis", "kind", "within", "moving"},
    "robot": {"name", "dh", "joints", "urdf", "base_link", "flange_link", "payload", "gravity", "repeatability"},
    "sphere": {"radius"},
    "part": {"cad", "cad_unit"},
}
# No length of a cell is larger in any unit; beyond, squares overflow.
LARGEST = 1e12


def read_session_document(file: Path) -> dict[str, Any]:
    """The document with known tables and keys only.

    Raises:
        InputError: missing, not TOML, of another format, or with a key that nobody knows.
    """
    hint = "a session is a folder with session.toml and views.csv"
    if file.parent.is_dir():
        # Whoever names the folder of the raw scans comes here first.
        hint += f"; to fix: `stitch init {shlex.quote(str(file.parent))}` makes one of scans and poses as they are"
    elif file.parent.exists():
        hint += f"; to fix: name a folder, {shlex.quote(str(file.parent))} is a file"
    else:
        hint += f"; to fix: name a folder that exists, {shlex.quote(str(file.parent))} does not"
    document = read_toml(file, hint)
    if document.get("format") != SESSION_FORMAT:
        raise InputError(f'{file}: format is {shortened(document.get("format"))}; expected "{SESSION_FORMAT}"')
    for table, known in _KEYS.items():
        entries = document if not table else document.get(table, {})
        if not isinstance(entries, dict):
            raise InputError(f"{file}: [{table}] must be a table")
        for key in entries:
            if key not in known:
                close = get_close_matches(key, known, 1)
                raise InputError(
                    f"{file}: unknown key {f'{table}.{key}' if table else key!r}"
                    + (f"; did you mean {close[0]!r}?" if close else f"; known are {', '.join(sorted(known))}")
                )
    return document


def session_name(file: Path, document: dict[str, Any]) -> str:
    """What the session is called: its name, or that of its folder.

    Raises:
        InputError: a name that cannot be that of its run's folder.
    """
    stated = optional_text(file, document, "", "name")
    return require_folder_name(str(file), file.resolve().parent.name if stated is None else stated, "name")


def positive_number(file: Path, table: dict[str, Any], name: str, key: str) -> float | None:
    """A positive number, or None where it is absent.

    Raises:
        InputError: anything else.
    """
    value = table.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < LARGEST:
        raise InputError(f"{file}: {name}.{key} is {shortened(value)}; use a positive number")
    return float(value)


def read_robot(file: Path, table: dict[str, Any] | None, unit: str) -> Robot | None:
    """[robot] by its DH rows or URDF; None without one.

    Raises:
        InputError: a value that cannot be, and how to fix it.
    """
    if not table:
        return None
    name = require_name(f"{file}: robot", optional_text(file, table, "robot", "name") or "robot", "name")
    gravity = table_numbers(f"{file}: robot", {"gravity": [0.0, 0.0, -9.81]} | table, "gravity", (3,))
    payload = table.get("payload")
    urdf, base, flange = (optional_text(file, table, "robot", key) for key in ("urdf", "base_link", "flange_link"))
    if urdf is not None:
        return robot_from_urdf(file.parent / urdf, base, flange, unit, gravity, payload)
    if "joints" not in table and "repeatability" in table:
        return None
    if "joints" not in table:
        raise InputError(f"{file}: [robot] needs joints (DH rows) or urdf")
    try:
        return robot_from_dh(name, str(table.get("dh", "standard")), table["joints"], payload, gravity, unit)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{file}: robot.joints: {error}; every row is {{ a, alpha_deg, d, theta_deg }}") from None


def read_repeatability(file: Path, table: dict[str, Any] | None) -> StatedRepeatability:
    """[robot] repeatability = { position, rotation_mrad }; position in length_unit.

    Raises:
        InputError: another key, or no positive number.
    """
    stated = (table or {}).get("repeatability")
    if stated is None:
        return StatedRepeatability()
    where = f"{file}: robot.repeatability"
    require_known_keys(where, stated, ("position", "rotation_mrad"))
    position, turn = (
        positive_number(file, stated, "robot.repeatability", key) for key in ("position", "rotation_mrad")
    )
    return StatedRepeatability(position, None if turn is None else turn / 1e3)


def cad_file(file: Path, table: dict[str, Any]) -> tuple[Path | None, str | None]:
    """Path and unit of the CAD file of [part]; None where they are absent.

    Raises:
        InputError: no such file, or another unit.
    """
    name = optional_text(file, table, "part", "cad")
    path = None if name is None else file.parent / name
    if path is not None and not path.is_file():
        raise InputError(f"{file}: part.cad names {path}, which is no file; to fix: correct the path")
    return path, table_choice(file, table, "cad_unit", tuple(METRES)) if "cad_unit" in table else None


# [scanner] of session.toml: where it sits, what it is, and which of what it shows counts.

# Effects of the scanner count its field as x/z and y/z: they know no scanner that looks along x or y.
_AXES = {"+z": np.array([0.0, 0.0, 1.0]), "-z": np.array([0.0, 0.0, -1.0])}


def read_scanner(file: Path, table: dict[str, Any]) -> Scanner:
    """[scanner]; lengths in length_unit.

    Raises:
        InputError: a value that cannot be, and how to fix it.
    """
    axis = table.get("optical_axis", "+z")
    if axis not in tuple(_AXES):
        raise InputError(
            f"{file}: scanner.optical_axis is {shortened(axis)}; turn the clouds until their scanner looks along z, "
            'and write the side: "+z" or "-z"'
        )
    T_mount = None
    if "pose" in table:
        T_mount = _read_pose(file, table["pose"])
    noise, standoff = (positive_number(file, table, "scanner", key) for key in ("noise", "standoff"))
    kind = table_choice(file, table, "kind", get_args(SensorKind)) if "kind" in table else None
    moving = table.get("moving", False)
    if not isinstance(moving, bool):
        raise InputError(f"{file}: scanner.moving is {shortened(moving)}; use true or false")
    return Scanner(T_mount, noise, standoff, _AXES[axis], cast(SensorKind | None, kind), moving)


def read_crop_box(file: Path, table: dict[str, Any]) -> Array | None:
    """[scanner] within: (2, 3) lowest and highest corner of the box that counts, scanner frame, length_unit.

    Raises:
        InputError: not two corners, or the second one not above the first.
    """
    if "within" not in table:
        return None
    try:
        box = np.array(table["within"])
    except ValueError:
        box = np.zeros(0)
    # Words and true are numbers to NumPy; integers of hundreds of digits are objects.
    is_box = box.shape == (2, 3) and box.dtype.kind in "if" and bool(np.isfinite(box).all())
    if not is_box or not (box[0] < box[1]).all():
        raise InputError(
            f"{file}: scanner.within is {shortened(table['within'])}; state the lowest and the highest corner of the "
            "box that counts, in the scanner's frame: [[-200, -200, 300], [200, 200, 600]]"
        )
    return box.astype(float)


def _read_pose(file: Path, value: Any) -> Array:
    try:
        T = np.array(value, float)
    except (TypeError, ValueError, OverflowError):
        T = np.empty(0)
    if T.shape != (4, 4) or not (np.abs(T) < LARGEST).all():
        raise InputError(f"{file}: scanner.pose is no 4×4 matrix; to fix: write four rows of four numbers")
    off = float(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max())
    if off > 1e-3 or np.linalg.det(T[:3, :3]) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputError(
            f"{file}: scanner.pose is not a rigid motion (R·Rᵀ differs from 1 by {off:.2g}, "
            f"det {np.linalg.det(T[:3, :3]):+.3f}); write a rotation, and 0 0 0 1 in the last row"
        )
    return frames.make(frames.nearest_rotation(T[:3, :3]), T[:3, 3])


# A hash that tells one measurement from another, wherever its files lie.

_TABLES = ("session.toml", "views.csv", "points.csv", "frames.csv", "targets.csv")
_BLOCK = 1 << 20
UNKNOWN = "–"


def session_hash(session: SessionData) -> str:
    """SHA-256 over the session's tables and the clouds that they name, in this order; first 16 digits.

    A dash where the session does not lie on disk any more.
    """
    try:
        files = measured_files(session.path)
    except (OSError, ValueError, csv.Error):
        return UNKNOWN
    return content_hash(session.path, files)


def measured_files(folder: Path) -> list[Path]:
    """The tables of a session's folder and the clouds that they name.

    Raises:
        OSError, ValueError, csv.Error: views.csv cannot be read.
    """
    files = [folder / name for name in _TABLES if (folder / name).is_file()]
    with open(folder / "views.csv", encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file, skipinitialspace=True))
    return files + [folder / row["cloud"].strip() for row in rows if row.get("cloud")]


def content_hash(folder: Path, files: Sequence[Path]) -> str:
    """SHA-256 over names and contents of files below a folder, in this order; first 16 digits.

    A dash where one cannot be read, or lies elsewhere.
    """
    found = hashlib.sha256()
    try:
        for path in files:
            found.update(path.relative_to(folder).as_posix().encode() + b"\0")
            with open(path, "rb") as file:
                while block := file.read(_BLOCK):
                    found.update(block)
    except (OSError, ValueError):
        return UNKNOWN
    return found.hexdigest()[:16]


# The scans that a session's views name, read on all cores: what counts of each, in length_unit.

# Fewer points span no surface.
_FEWEST = 3


def read_scans(
    path: Path,
    rows: Sequence[ViewRow],
    length_unit: str,
    cloud_unit: str,
    scanner: Scanner,
    *,
    within: Array | None,
    at_most: int | None,
) -> Iterator[Cloud | None]:
    """The scans of a session folder in the order of its rows, None where a row names none.

    Args:
        cloud_unit: of the files; the clouds come in length_unit.
        within: (2, 3) lowest and highest corner of the box that counts, scanner frame, length_unit; None: all counts.
        at_most: points of a view that stay in memory; None: all.

    Raises:
        InputError: a file missing, broken, with too few points or in another unit; names the view and its line.
    """
    read = partial(_read_cropped, scale=METRES[cloud_unit] / METRES[length_unit], within=within)
    cloud = partial(_scan_of_row, path, read=read, metres=METRES[length_unit], scanner=scanner, at_most=at_most)
    return parallel(cloud, rows, "reading scans")


def _scan_of_row(
    path: Path, row: ViewRow, read: Callable[[Path], Cloud], metres: float, scanner: Scanner, at_most: int | None
) -> Cloud | None:
    if not row.cloud:
        return None
    file = path / row.cloud
    try:
        return checked_scan(row.name, str(file), partial(read, file), metres=metres, scanner=scanner, at_most=at_most)
    except InputError as error:
        raise InputError(f"view {row.name} (views.csv line {row.line}): {error}") from None


def checked_scan(
    name: str, where: str, read: Callable[[], Cloud], *, metres: float, scanner: Scanner, at_most: int | None
) -> Cloud:
    """Read one scan, check it, and keep so many of its points in memory.

    Args:
        name: of the view.
        where: file, or name of the scan, for messages.
        read: gives the whole scan in length_unit, and once more when it is fused.
        metres: in one length_unit.
        at_most: points that stay in memory; None: all.

    Raises:
        InputError: too few points, or one farther away than any sensor sees.
    """

    whole = read()
    cloud = distinct_points(whole)
    if len(cloud.points) < _FEWEST:
        raise InputError(
            f"{where}: {len(cloud.points)} of at least {_FEWEST} points; leave this view out of views.csv or scan "
            "it again"
        )
    # Looked at before some are taken: each of them will be fused.
    require_near(where, cloud.points * metres)
    if at_most is None:
        return cloud
    return thin_cloud(name, cloud, at_most, scanner, read if cloud is whole else lambda: distinct_points(read()))


def _read_cropped(file: Path, scale: float, within: Array | None) -> Cloud:
    """A scan in length_unit, what counts of it."""
    cloud = read_cloud(file, scale)
    if within is None:
        return cloud
    inside = cloud.within(within)
    if not len(inside.points):
        middle = ", ".join(f"{x:.3g}" for x in np.median(cloud.points, axis=0))
        raise InputError(
            f"{file}: none of its {len(cloud.points)} points is in the box scanner.within of session.toml, their "
            f"middle lies at ({middle}); to fix: make the box larger, or leave this view out of views.csv"
        )
    return inside


@readable()
def load_session(
    path: Path | str,
    scans: bool = True,
    start: Array | None = None,
    at_most: int | None = MAX_POINTS,
    memory: float | None = None,
    only: str | None = None,
) -> SessionData:
    """Read and check a session folder.

    Args:
        only: name of the one view that is read; None: all.
        scans: False reads neither clouds nor labelled points, for questions about the arm alone.
        at_most: points of a view that stay in memory, the others in their files until they are fused; None: all.
        memory: bytes within which a run of the session has to stay; may be less than `at_most` asks for.
        start: (n,) rad: joint angles of the only view, where nobody has planned any and there is no views.csv.

    Raises:
        InputError: anything missing, contradictory or implausible; names file, line or view, and how to fix it.
    """
    path = Path(path)
    file = path / "session.toml"
    document = read_session_document(file)
    unit = table_choice(file, document, "length_unit", tuple(METRES))
    mount = table_choice(file, document, "mount", get_args(Mount))
    robot = read_robot(file, document.get("robot"), unit)
    rows = read_views(path / "views.csv", robot) if start is None else [row_at(file, robot, start)]
    rows = [row for row in rows if only is None or row.name == only]
    cloud_unit = table_choice(file, {"cloud_unit": unit} | document, "cloud_unit", tuple(METRES))
    scanner = read_scanner(file, document.get("scanner", {}))
    # A scan that is moved point by point cannot be read once more from its file.
    at_most = None if scanner.moving else at_most
    views = _read_session_views(path, document, rows, scanner, scans=scans, at_most=at_most, memory=memory)
    cad, cad_unit = cad_file(file, document.get("part", {}))
    session = SessionData(
        path=path,
        name=session_name(file, document),
        length_unit=unit,
        mount=mount,  # type: ignore[arg-type]
        scanner=scanner,
        robot=robot,
        sphere_radius=positive_number(file, document.get("sphere", {}), "sphere", "radius"),
        cad=cad,
        cad_unit=cad_unit,
        views=views,
        nominal=_read_nominal(path, views),
        repeatability=read_repeatability(file, document.get("robot")),
    )
    if scans:
        check_scale(session, cloud_unit)
    # One view alone says nothing of how the robot moved.
    return stand_still(session) if scanner.moving and scans and only is None else session


def _read_sightings(path: Path, known: list[str]) -> dict[str, Sighting]:
    """By view, from points.csv or frames.csv."""
    points, frames_file = path / "points.csv", path / "frames.csv"
    for optional in (points, frames_file, path / "targets.csv"):
        if optional.exists() or optional.is_symlink():
            require_file(optional, "write the table, or remove it")
    if points.is_file() and frames_file.is_file():
        raise InputError(f"{path}: has points.csv and frames.csv; keep one of them: a session has one kind of target")
    if points.is_file():
        return read_points(points, known)
    if not frames_file.is_file():
        return {}
    measured = read_frames(frames_file, known)
    unknown = np.full(len(measured.views), np.nan)
    sigma = unknown if measured.sigma is None else measured.sigma
    turn = unknown if measured.sigma_rotation is None else measured.sigma_rotation
    return {
        view: Sighting(("probe",), T[None, :3, 3], sigma[v : v + 1], T[:3, :3], float(turn[v]))
        for v, (view, T) in enumerate(zip(measured.views, measured.T_sensor_probe, strict=True))
    }


def _read_nominal(path: Path, views: tuple[View, ...]) -> NominalTargets | None:
    file = path / "targets.csv"
    if not file.is_file():
        return None
    if not (path / "points.csv").is_file():
        raise InputError(f"{file}: there is no points.csv that names its targets; write it, or remove targets.csv")
    seen = (view.sighting.targets for view in views if view.sighting is not None)
    return read_targets(file, sorted({name for names in seen for name in names}))


def _read_session_views(
    path: Path,
    document: dict[str, Any],
    rows: list[ViewRow],
    scanner: Scanner,
    *,
    scans: bool,
    at_most: int | None,
    memory: float | None,
) -> tuple[View, ...]:
    """The rows with what was seen."""
    sightings = _read_sightings(path, [row.name for row in rows]) if scans else {}
    if memory is not None:
        at_most = min(at_most or MAX_POINTS, points_within(memory, len(rows)))
    within = read_crop_box(path / "session.toml", document.get("scanner", {}))
    unit = document["length_unit"]
    clouds: Iterable[Cloud | None] = [None] * len(rows)
    if scans:
        cloud_unit = document.get("cloud_unit", unit)
        clouds = read_scans(path, rows, unit, cloud_unit, scanner, within=within, at_most=at_most)
    views = []
    for row, cloud in zip(rows, clouds, strict=True):
        if scans and cloud is None and not sightings:
            raise InputError(
                f"{path / 'views.csv'} line {row.line}: view {row.name} names no cloud; fill the column "
                "cloud, or put points.csv or frames.csv beside it"
            )
        views.append(
            View(
                name=row.name,
                cloud=cloud,
                T_base_flange=row.T_base_flange,
                joints=row.joints,
                approach=row.approach,
                time_s=row.time_s,
                covariates=row.covariates,
                sighting=sightings.get(row.name),
            )
        )
    return tuple(views)
