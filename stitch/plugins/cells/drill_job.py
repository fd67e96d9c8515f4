"""A drilling job as its files say it: the holes of the drawing, the plate, and where the tool was placed."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.errors import InputError, NoResultError
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.plugins.cells.drill_checks import holes_in_flange, read_pin, read_trials
from stitch.plugins.cells.drilling_sensors import (
    HoleObservations,
    base_frame,
    fit_homography,
    hole_at_tool,
    holes_of_plate,
)
from stitch.plugins.cells.job_files import (
    POSE_COLUMNS,
    CsvColumns,
    JobTable,
    poses_from_columns,
    read_columns,
    read_job_file,
    require_unique,
)
from stitch.session.reading.csv_files import read_csv_rows

DRILL_FORMAT = "stitch-drill/1"
_FILES = {"plate", "plate_image", "holes", "placed", "rangers", "joint1", "joint6", "checks", "locating", "trials"}
_KEYS = {"format", "length_unit", "height", "image_size", "home", "joint6_height", "pin", "servo", *_FILES}
# Cosine of the largest angle between tool and hole that a small error explains.
_ALONG = float(np.cos(np.radians(30)))
_SERVO_KEYS = ("tilt_deg", "height", "offset", "seconds")
_NEEDED = ("plate", "holes", "placed")


@dataclass(frozen=True)
class Hole:
    """One hole as the part's drawing puts it in the base frame."""

    name: str
    group: str
    reference: bool
    position: Array  # (3,)
    direction: Array  # (3,) unit vector into the part


@dataclass(frozen=True)
class PlacedTool:
    """Where the servo loop ended on a reference hole, and what the camera and the rangers saw there."""

    T_base_tool: Array  # (4, 4) reported
    uv: Array  # (2,) pixels
    height: float  # of the hole along the flange's z, h' of the source


@dataclass(frozen=True)
class Thresholds:
    """When the tool counts as placed, and how long a move may take; by default the source's."""

    tilt: float = float(np.radians(0.35))  # rad
    height: float = 0.5  # length_unit
    offset: float = 0.2  # length_unit
    seconds: float = 120.0


@dataclass(frozen=True)
class DrillJob:
    """Everything of one drilling job. Lengths in length_unit."""

    length_unit: str
    height: float
    plate_xyz: Array  # (N, 3) flange frame
    plate_uv: Array  # (N, 2)
    holes: tuple[Hole, ...]
    placed: dict[str, PlacedTool]  # by the reference hole
    placed_file: Path
    thresholds: Thresholds  # of the servo loop
    rangers: dict[str, tuple[Array, Array]]  # planes (M, 4), readings (M,)
    marker_paths: tuple[Array, Array] | None  # joint 6, joint 1, in the measuring system
    checks: HoleObservations | None  # plate and check holes together
    joint6_height: float = 0.0  # of the axis of joint 6 above the base's origin
    locating_rms: float | None = None  # of the plate's locating holes; None: the plate is given in the flange frame
    trials: CsvColumns | None = None
    pin: tuple[float, float] | None = None  # diameter, feed
    file: Path | None = None  # that was read


def read_drill_job(file: Path | str, driven: bool = False) -> DrillJob:
    """Read a job file and the tables it names, whose paths are relative to it.

    Args:
        driven: the tool is yet to be driven onto reference holes that have no row in the table `placed`.

    Raises:
        InputError: anything missing, unknown, contradictory or not a number; names the file, the place and what to do.
    """
    file = Path(file)
    document = read_job_file(file, DRILL_FORMAT, _KEYS, "examples/drilling/job.toml")
    paths = {key: document.path(key) for key in _FILES if key in document}
    for key in _NEEDED:
        if key not in paths:
            raise InputError(f"{file}: {key} is missing; to fix: name the CSV file")
    plate_xyz, plate_uv = _read_plate(paths["plate"], paths.get("plate_image"))
    marker_paths = _read_marker_paths(file, paths)
    joint6_height = document.number("joint6_height", 0.0)
    locating_rms = None
    if "locating" in paths:
        if marker_paths is None or "home" not in document:
            raise InputError(f"{file}: locating goes with joint1, joint6 and [home]; to fix: add them")
        try:
            T_measuring_base = base_frame(*marker_paths, joint6_height)
        except NoResultError as error:
            raise InputError(f"{file}: {error}") from None
        T_measuring_flange = T_measuring_base @ document.pose("home")
        plate_xyz, locating_rms = holes_in_flange(paths["locating"], plate_xyz, T_measuring_flange)
    holes = _read_holes(paths["holes"])
    pin = read_pin(document)
    rangers = _read_ranger_tables(paths["rangers"]) if "rangers" in paths else {}
    return DrillJob(
        length_unit=document.choice("length_unit", METRES),
        height=document.number("height", positive=True),
        plate_xyz=plate_xyz,
        plate_uv=plate_uv,
        holes=holes,
        placed=_read_placed_tools(paths["placed"], holes, plate_xyz, plate_uv, driven),
        placed_file=paths["placed"],
        thresholds=_read_thresholds(document),
        rangers=rangers,
        marker_paths=marker_paths,
        checks=_read_check_holes(document, paths["checks"], plate_xyz, plate_uv) if "checks" in paths else None,
        joint6_height=joint6_height,
        locating_rms=locating_rms,
        trials=read_trials(paths["trials"], tuple(rangers), pin is not None) if "trials" in paths else None,
        pin=pin,
        file=file,
    )


def _read_thresholds(document: JobTable) -> Thresholds:
    """Return the thresholds of the job's table [servo], the source's where it says none."""
    table = document.table("servo", _SERVO_KEYS)
    usual = Thresholds()
    tilt_deg = table.number("tilt_deg", float(np.degrees(usual.tilt)), positive=True)
    others = {key: table.number(key, getattr(usual, key), positive=True) for key in _SERVO_KEYS[1:]}
    return Thresholds(float(np.radians(tilt_deg)), **others)


def _read_plate(file: Path, picture: Path | None) -> tuple[Array, Array]:
    """Read the plate's holes, flange frame (N, 3) and pixels (N, 2); with a picture, pixels come from there."""
    if picture is None:
        plate = read_columns(file, "", "x y z u v")
        return plate.stack("x y z"), plate.stack("u v")
    xyz = read_columns(file, "", "x y z").stack("x y z")
    uv = holes_of_plate(picture)
    if len(xyz) != len(uv):
        raise InputError(f"{file}: has {len(xyz)} rows; to fix: with plate_image, list the {len(uv)} holes it shows")
    return xyz, uv


def _read_holes(file: Path) -> tuple[Hole, ...]:
    table = read_columns(file, "hole group kind", "x y z i j k")
    rows = zip(*table.texts.values(), table.stack("x y z"), table.stack("i j k"), strict=True)
    holes: list[Hole] = []
    for name, group, kind, position, direction in rows:
        size = np.linalg.norm(direction)
        if abs(size - 1) > 0.01:
            raise InputError(
                f"{file}: direction of hole {name} has length {size:.4f}; to fix: write i, j, k as a unit vector"
            )
        if kind not in ("reference", "drill"):
            raise InputError(f"{file}: kind of hole {name} is {kind!r}; to fix: write reference or drill")
        holes.append(Hole(name, group, kind == "reference", position, direction / size))
    for (name, group), count in Counter((hole.name, hole.group) for hole in holes).items():
        if count > 1:
            raise InputError(f"{file}: hole {name} stands twice in group {group}; to fix: leave one of them out")
    return tuple(holes)


def _read_placed_tools(
    file: Path, holes: tuple[Hole, ...], plate_xyz: Array, plate_uv: Array, driven: bool
) -> dict[str, PlacedTool]:
    """Read where the tool ended; a column image in place of u and v names a picture of each hole."""
    if driven and not file.exists():
        return {}
    header, _ = read_csv_rows(file)
    if "image" in header and "u" not in header:
        table = read_columns(file, "hole image", f"{POSE_COLUMNS} height")
        H = fit_homography(plate_xyz[:, :2], plate_uv)
        pixels = np.array([hole_at_tool(file.parent / name, H) for name in table.texts["image"]])
    else:
        table = read_columns(file, "hole", f"{POSE_COLUMNS} u v height")
        pixels = table.stack("u v")
    poses = poses_from_columns(table)
    names = table.texts["hole"]
    require_unique(file, "hole", names)
    for hole in holes:
        if not hole.reference or (driven and hole.name not in names):
            continue
        if hole.name not in names:
            raise InputError(f"{file}: reference hole {hole.name} is missing; to fix: add where the robot ended on it")
        if poses[names.index(hole.name), :3, 2] @ hole.direction < _ALONG:
            raise InputError(
                f"{file}: on hole {hole.name} the tool's z lies more than 30° off the hole's direction; to fix: let "
                "directions point into the part, and a, b, c turn about z, y', x''"
            )
    tools = map(PlacedTool, poses, pixels, table.numbers["height"].tolist())
    return dict(zip(names, tools, strict=True))


def _read_ranger_tables(file: Path) -> dict[str, tuple[Array, Array]]:
    table = read_columns(file, "ranger", "a b c d reading")
    planes = table.stack("a b c d")
    readings = table.numbers["reading"]
    names = np.array(table.texts["ranger"])
    if (np.linalg.norm(planes[:, :3], axis=1) == 0).any():
        raise InputError(f"{file}: a plane has a = b = c = 0; to fix: write its normal there")
    return {str(name): (planes[names == name], readings[names == name]) for name in dict.fromkeys(names)}


def _read_marker_paths(file: Path, paths: dict[str, Path]) -> tuple[Array, Array] | None:
    if ("joint1" in paths) != ("joint6" in paths):
        raise InputError(f"{file}: joint1 and joint6 belong together; to fix: name both marker paths or neither")
    if "joint1" not in paths:
        return None
    joint6, joint1 = (read_columns(paths[key], "", "x y z").stack("x y z") for key in ("joint6", "joint1"))
    return joint6, joint1


def _read_check_holes(document: JobTable, file: Path, plate_xyz: Array, plate_uv: Array) -> HoleObservations:
    """Read holes of the plate and check holes together."""
    width, height = document.vectors("image_size", (2,), "[width, height] in pixels, which the checks need").tolist()
    if min(width, height) <= 0:
        raise document.refusal("image_size", "write numbers above zero")
    checks = read_columns(file, "", "x y z u v")
    return HoleObservations(
        xyz=np.vstack([plate_xyz, checks.stack("x y z")]),
        uv=np.vstack([plate_uv, checks.stack("u v")]),
        on_plate=np.repeat([True, False], [len(plate_xyz), checks.rows]),
        image_size=(width, height),
    )
