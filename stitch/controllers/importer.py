"""A controller's or tracker's file -> the text of views.csv, frames.csv or points.csv."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stitch import frames
from stitch.controllers import tracker_csv, universal
from stitch.controllers.imported_rows import POSE_COLUMNS, csv_text, numbered_names, pose_cells, view_rows
from stitch.controllers.program import NOTHING_IN_FORCE, PROGRAMS, require_one_frame, stated_pose
from stitch.controllers.taught import TaughtPoint
from stitch.controllers.tracker_csv import TrackerPoint
from stitch.errors import InputError, NoResultError

_READERS = PROGRAMS | {".csv": universal}
# Programs are in mm; views.csv is in the session's length_unit.
_MM_IN_UNIT = {"mm": 1.0, "m": 1e-3}


@dataclass(frozen=True)
class ImportedTable:
    """A table of a session."""

    table: str  # "views.csv", "frames.csv" or "points.csv"
    text: str
    rows: int
    convention: str  # how the file writes orientations
    warnings: tuple[str, ...]


def import_file(file: Path, unit: str = "mm", frame: str | None = None, tool: str | None = None) -> ImportedTable:
    """Read a program or an export of a tracker.

    Args:
        unit: "mm" or "m", the session's length_unit.
        frame: T_base_frame in which the points were taught, numbers as the controller writes a pose.
        tool: T_flange_tool in force when they were taught, likewise. T_base_flange = frame · point · tool⁻¹.

    Raises:
        InputError: unknown or broken file, points of different frames; names the line and how to fix it.
        NoResultError: no points in the file.
    """
    if not file.is_file():
        raise InputError(f"{file}: no such file; to fix: name an export of the controller")
    if unit not in _MM_IN_UNIT:
        raise InputError(f"--unit {unit}: use mm or m")
    reader = _READERS.get(file.suffix.lower())
    if reader is None:
        raise InputError(
            f"{file}: unknown kind {file.suffix!r}; known are {', '.join(_READERS)}; to fix: save it as one of these, "
            f"or let `stitch init {file.parent}` read the folder, if it is a scan"
        )
    text = file.read_text(encoding="utf-8-sig", errors="replace")
    if not text.strip():
        raise InputError(f"{file}: empty; export it again")
    if reader is universal and file.suffix.lower() == ".csv" and not universal.is_recording(text):
        return _import_tracker(file, text, unit)
    points: Sequence[TaughtPoint] = reader.read(file, text)
    if not points:
        raise NoResultError(f"{file}: no taught points found; export the program with its positions")
    warnings = _check_frames(file, points, frame, tool)
    T_base_frame, T_flange_tool = stated_pose(reader.pose, "frame", frame), stated_pose(reader.pose, "tool", tool)
    rows = view_rows(points, T_base_frame, frames.inverse(T_flange_tool), _MM_IN_UNIT[unit])
    return ImportedTable("views.csv", csv_text(rows), len(points), reader.CONVENTION, warnings)


def _check_frames(file: Path, points: Sequence[TaughtPoint], frame: str | None, tool: str | None) -> tuple[str, ...]:
    """Points of one frame and tool, or a refusal; a warning where poses need them and none was given."""
    taught_in = require_one_frame(file, points)
    if taught_in is None:
        return ()
    if (frame is None or tool is None) and taught_in not in NOTHING_IN_FORCE:
        known = f" ({taught_in})" if taught_in else ""
        return (
            f"poses are those of the tool in the frame in which they were taught{known}; give --frame and --tool "
            "unless both were zero, else they are not the flange in the base",
        )
    return ()


def _import_tracker(file: Path, text: str, unit: str) -> ImportedTable:
    """frames.csv from 6D probes; points.csv from reflectors, a new view whenever a name comes again."""
    measured: list[TrackerPoint] = tracker_csv.read(file, text)
    if not measured:
        raise NoResultError(f"{file}: no measurements; export them again")
    scale = _MM_IN_UNIT[unit]
    poses = [m.T_sensor_probe for m in measured if m.T_sensor_probe is not None]
    if poses:
        rows = [["view", *POSE_COLUMNS]]
        rows += [
            [n, *pose_cells(T, scale)] for n, T in zip(numbered_names(m.name for m in measured), poses, strict=True)
        ]
        return ImportedTable("frames.csv", csv_text(rows), len(measured), tracker_csv.CONVENTION, ())
    rows, seen = [["view", "target", "x", "y", "z"]], Counter[str]()
    for m in measured:
        seen[m.name] += 1
        rows.append([f"v{seen[m.name]}", m.name, *(f"{x * scale:.9g}" for x in m.position)])
    note = (
        "points.csv: the first measurement of every name is view v1, the second v2; name the views in views.csv alike"
    )
    return ImportedTable("points.csv", csv_text(rows), len(measured), tracker_csv.CONVENTION, (note,))
