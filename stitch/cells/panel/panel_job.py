"""A panel job (TOML) and its CSV files -> `Job`; every check of the input is made here."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.cells.job_toml import check_keys, choice, finite, read_job_file, resolve_file, table, vectors
from stitch.cells.panel.global_model import ReflectorReadings
from stitch.cells.panel.laser_tracker import LaserTracker
from stitch.cells.panel.layout import ClampLayout, clamp_contacts
from stitch.cells.panel.legs import Legs
from stitch.cells.panel.panel_tables import PanelPoints, read_calibration, read_panel_points, read_per_robot, read_world
from stitch.cells.pose_table import POSE_COLUMNS, pose_from_table, poses_from_rows
from stitch.errors import InputError
from stitch.frames import Array

PANEL_FORMAT = "stitch-panel/1"
_KEYS = {"format", "robots", "master", "target", "layout", "tracker", "shape", "legs", "files"}
_AXES = ("rx", "ry", "rz", "x", "y", "z")
_FILES = {"calibration", "flanges", "targets", "control", "forces", "world"}
_LAYOUT = ("radius", "clamp_width", "spacing", "clamp_height", "edge", "length")


@dataclass(frozen=True)
class PanelJob:
    """What a panel cell has measured. Lengths in mm, forces in N; robots row by row as the layout counts clamps."""

    robots: tuple[str, ...]
    master: int
    T_world_target: Array  # (4, 4)
    layout: ClampLayout
    tracker: LaserTracker
    tolerance: float  # of the shape, mm
    axes: Array  # (6,) bool, driven axes of shape control: turns about x, y, z, then x, y, z
    legs: Legs | None
    calibration: tuple[ReflectorReadings, ...]
    flanges: Array | None  # (N, 4, 4) where the controllers believe the flanges are
    targets: PanelPoints | None
    control: PanelPoints | None
    forces: Array | None  # (N, 6) change of torques and forces
    file: Path | None = None  # that was read


def read_panel_job(file: Path | str) -> PanelJob:
    """Read and check a panel job.

    Raises:
        InputError: a file is missing or malformed; an entry is missing, unknown, not a number or impossible.
    """
    file = Path(file)
    document = read_job_file(file, PANEL_FORMAT, _KEYS, "examples/panel/job.toml")
    robots = document.get("robots")
    if not isinstance(robots, list) or len(robots) < 2 or not all(isinstance(r, str) for r in robots):
        raise InputError(f"{file}: robots is {robots!r}; list the robots' names, row by row")
    if len(set(robots)) != len(robots) or len(robots) % 2:
        raise InputError(f"{file}: robots must be an even number of different names, half of them in each row")
    names = tuple(robots)
    paths = _file_paths(file, table(file, document, "files"))
    tracker = _read_tracker(file, table(file, document, "tracker"))
    T_world_tracker = np.eye(4)
    if "world" in paths:
        T_world_tracker = read_world(paths["world"], tracker)
        tracker = replace(tracker, position=T_world_tracker[:3, 3])
    tolerance, axes = _read_shape(file, document.get("shape", {}))
    flanges = read_per_robot(paths["flanges"], names, POSE_COLUMNS) if "flanges" in paths else None
    return PanelJob(
        robots=names,
        master=names.index(choice(file, "master", document.get("master"), names)),
        T_world_target=pose_from_table(file, "target", table(file, document, "target")),
        layout=_read_layout(file, document, len(names) // 2),
        tracker=tracker,
        tolerance=tolerance,
        axes=axes,
        legs=_read_legs(file, document.get("legs")),
        calibration=read_calibration(paths["calibration"], names, tracker, T_world_tracker),
        flanges=None if flanges is None else poses_from_rows(flanges),
        targets=read_panel_points(paths["targets"], None, T_world_tracker) if "targets" in paths else None,
        control=read_panel_points(paths["control"], names, T_world_tracker) if "control" in paths else None,
        forces=read_per_robot(paths["forces"], names, "tx ty tz fx fy fz") if "forces" in paths else None,
        file=file,
    )


def _read_layout(file: Path, document: dict[str, Any], columns: int) -> ClampLayout:
    entries = table(file, document, "layout")
    check_keys(file, "layout", entries, set(_LAYOUT))
    sizes = {key: finite(file, f"layout.{key}", entries.get(key), positive=True) for key in _LAYOUT}
    layout = ClampLayout(columns=columns, **sizes)
    try:
        clamp_contacts(layout)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    return layout


def _read_tracker(file: Path, entries: dict[str, Any]) -> LaserTracker:
    check_keys(file, "tracker", entries, {"position", "constant", "per_length"})
    return LaserTracker(
        vectors(file, "tracker.position", entries.get("position"), (3,), "[x, y, z] in mm"),
        constant=finite(file, "tracker.constant", entries.get("constant", 0.010), positive=True),
        per_length=finite(file, "tracker.per_length", entries.get("per_length", 5e-6), positive=True),
    )


def _read_shape(file: Path, entries: Any) -> tuple[float, Array]:
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


def _read_legs(file: Path, entries: Any) -> Legs | None:
    if entries is None:
        return None
    check_keys(file, "legs", entries, {"base", "platform"})
    form = "6 points [x, y, z] in mm"
    legs = Legs(*(vectors(file, f"legs.{key}", entries.get(key), (6, 3), form) for key in ("base", "platform")))
    for name, joints in (("base", legs.base), ("platform", legs.platform)):
        if np.linalg.matrix_rank(joints - joints.mean(axis=0), tol=1e-3) < 2:
            raise InputError(f"{file}: legs.{name}: the six joints lie on one line; give them in mm, leg by leg")
    return legs


def _file_paths(file: Path, entries: dict[str, Any]) -> dict[str, Path]:
    check_keys(file, "files", entries, _FILES)
    if "calibration" not in entries:
        raise InputError(f"{file}: files.calibration is missing; without it nothing is known about the robots")
    for first, second in (("targets", "flanges"), ("control", "flanges")):
        if first in entries and second not in entries:
            raise InputError(f"{file}: files.{first} needs files.{second}: where the robots stood at that time")
    return {key: resolve_file(file, f"files.{key}", value) for key, value in entries.items()}
