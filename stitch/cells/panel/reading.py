"""A panel job (TOML) and its CSV files -> `Job`; every check of the input is made here."""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stitch.cells.csv_table import Columns, read_columns
from stitch.cells.panel.global_model import Readings
from stitch.cells.panel.layout import Layout
from stitch.cells.panel.legs import Legs
from stitch.cells.panel.tracker import Tracker
from stitch.cells.pose_table import COLUMNS, from_columns, from_numbers
from stitch.cells.toml_tables import check_keys, choice, finite, table
from stitch.errors import InputError
from stitch.frames import Array, Indices

FORMAT = "stitch-panel/1"
_AXES = ("rx", "ry", "rz", "x", "y", "z")
_FILES = {"calibration", "flanges", "targets", "control", "forces"}
_LAYOUT = ("radius", "clamp_width", "spacing", "clamp_height", "edge", "length")


@dataclass(frozen=True)
class Points:
    """Targets on the panel and where the tracker sees them, mm."""

    names: list[str]
    nominal: Array  # (K, 3) panel frame
    seen: Array  # (K, 3) world frame
    clamp: Indices  # (K,) index of the robot; −1 where the file has none


@dataclass(frozen=True)
class Job:
    """What a panel cell has measured. Lengths in mm, forces in N; robots row by row as the layout counts clamps."""

    robots: tuple[str, ...]
    master: int
    T_world_target: Array  # (4, 4)
    layout: Layout
    tracker: Tracker
    tolerance: float  # of the shape, mm
    axes: Array  # (6,) bool, driven axes of shape control: turns about x, y, z, then x, y, z
    legs: Legs | None
    calibration: tuple[Readings, ...]
    flanges: Array | None  # (N, 4, 4) where the controllers believe the flanges are
    targets: Points | None
    control: Points | None
    forces: Array | None  # (N, 6) change of torques and forces


def read_job(file: Path | str) -> Job:
    """Read and check a panel job.

    Raises:
        InputError: a file is missing or malformed; an entry is missing, unknown, not a number or impossible.
    """
    file = Path(file)
    document = _document(file)
    robots = document.get("robots")
    if not isinstance(robots, list) or len(robots) < 2 or not all(isinstance(r, str) for r in robots):
        raise InputError(f"{file}: robots is {robots!r}; list the robots' names, row by row")
    if len(set(robots)) != len(robots) or len(robots) % 2:
        raise InputError(f"{file}: robots must be an even number of different names, half of them in each row")
    names = tuple(robots)
    target = table(file, document, "target")
    check_keys(file, "target", target, set(COLUMNS.split()))
    pose = [finite(file, f"target.{key}", target.get(key)) for key in COLUMNS.split()]
    entries = table(file, document, "layout")
    check_keys(file, "layout", entries, set(_LAYOUT))
    sizes = {key: finite(file, f"layout.{key}", entries.get(key), positive=True) for key in _LAYOUT}
    tracker = _tracker(file, table(file, document, "tracker"))
    tolerance, axes = _shape(file, document.get("shape", {}))
    paths = _paths(file, table(file, document, "files"))
    flanges = _per_robot(paths["flanges"], names, COLUMNS) if "flanges" in paths else None
    return Job(
        names, names.index(choice(file, "master", document.get("master"), names)), from_numbers(np.array(pose)),
        Layout(columns=len(names) // 2, **sizes), tracker, tolerance, axes, _legs(file, document.get("legs")),
        _calibration(paths["calibration"], names, tracker), None if flanges is None else from_numbers(flanges),
        _points(paths["targets"], None) if "targets" in paths else None,
        _points(paths["control"], names) if "control" in paths else None,
        _per_robot(paths["forces"], names, "tx ty tz fx fy fz") if "forces" in paths else None,
    )  # fmt: skip


def _document(file: Path) -> dict[str, Any]:
    try:
        document = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{file}: not found; see examples/panel/job.toml for how a job looks") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not valid TOML: {error}") from None
    if document.get("format") != FORMAT:
        raise InputError(f'{file}: format is {document.get("format")!r}; expected "{FORMAT}"')
    check_keys(
        file, "", document, {"format", "robots", "master", "target", "layout", "tracker", "shape", "legs", "files"}
    )
    return document


def _tracker(file: Path, entries: dict[str, Any]) -> Tracker:
    check_keys(file, "tracker", entries, {"position", "constant", "per_length"})
    position = _vectors(file, "tracker.position", [entries.get("position")], 1)[0]
    return Tracker(
        position, finite(file, "tracker.constant", entries.get("constant", 0.010), positive=True),
        finite(file, "tracker.per_length", entries.get("per_length", 5e-6), positive=True),
    )  # fmt: skip


def _shape(file: Path, entries: Any) -> tuple[float, Array]:
    check_keys(file, "shape", entries, {"tolerance", "axes"})
    axes = entries.get("axes", ["rx", "ry", "z"])
    if not isinstance(axes, list) or not axes:
        raise InputError(f"{file}: shape.axes is {axes!r}; list some of {', '.join(_AXES)}")
    for axis in axes:
        choice(file, "shape.axes", axis, _AXES)
    return (
        finite(file, "shape.tolerance", entries.get("tolerance", 0.6), positive=True),
        np.array([axis in axes for axis in _AXES]),
    )


def _legs(file: Path, entries: Any) -> Legs | None:
    if entries is None:
        return None
    check_keys(file, "legs", entries, {"base", "platform"})
    return Legs(*(_vectors(file, f"legs.{key}", entries.get(key), 6) for key in ("base", "platform")))


def _vectors(file: Path, place: str, value: Any, count: int) -> Array:
    ok = isinstance(value, list) and len(value) == count and all(isinstance(v, list) and len(v) == 3 for v in value)
    if not ok:
        raise InputError(f"{file}: {place} must be {'[x, y, z]' if count == 1 else f'{count} points [x, y, z]'} in mm")
    return np.array([[finite(file, place, number) for number in v] for v in value])


def _paths(file: Path, entries: dict[str, Any]) -> dict[str, Path]:
    check_keys(file, "files", entries, _FILES)
    if "calibration" not in entries:
        raise InputError(f"{file}: files.calibration is missing; without it nothing is known about the robots")
    for first, second in (("targets", "flanges"), ("control", "flanges")):
        if first in entries and second not in entries:
            raise InputError(f"{file}: files.{first} needs files.{second}: where the robots stood at that time")
    for key, value in entries.items():
        if not isinstance(value, str):
            raise InputError(f"{file}: files.{key} is {value!r}; name a CSV file in quotes")
    return {key: file.parent / value for key, value in entries.items()}


def _calibration(file: Path, names: tuple[str, ...], tracker: Tracker) -> tuple[Readings, ...]:
    columns = read_columns(file, "robot", f"{COLUMNS} x1 y1 z1 x2 y2 z2 x3 y3 z3")
    poses, seen = from_columns(columns), columns.stack("x1 y1 z1 x2 y2 z2 x3 y3 z3").reshape(-1, 3, 3)
    robot = np.array(columns.texts["robot"])
    _known(file, columns, names)
    for name in names:
        if not (robot == name).any():
            raise InputError(f"{file}: robot {name} has no row; measure its poses, or leave it out of the job")
    return tuple(Readings(n, poses[robot == n], seen[robot == n], tracker.sigma(seen[robot == n])) for n in names)


def _per_robot(file: Path, names: tuple[str, ...], wanted: str) -> Array:
    columns = read_columns(file, "robot", wanted)
    _known(file, columns, names)
    listed = columns.texts["robot"]
    for name in names:
        if listed.count(name) != 1:
            raise InputError(f"{file}: robot {name} stands in {listed.count(name)} rows; give each robot one")
    return columns.stack(wanted)[[listed.index(name) for name in names]]


def _points(file: Path, robots: tuple[str, ...] | None) -> Points:
    columns = read_columns(file, "point robot" if robots else "point", "x y z seen_x seen_y seen_z")
    clamp = np.full(columns.rows, -1)
    if robots:
        _known(file, columns, robots)
        clamp = np.array([robots.index(name) for name in columns.texts["robot"]])
    return Points(columns.texts["point"], columns.stack("x y z"), columns.stack("seen_x seen_y seen_z"), clamp)


def _known(file: Path, columns: Columns, names: tuple[str, ...]) -> None:
    for name in columns.texts["robot"]:
        if name not in names:
            raise InputError(f"{file}: robot {name!r} is not in the job's robots {', '.join(names)}; mend its name")
