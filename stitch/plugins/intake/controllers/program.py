"""A robot program with the places of its numbers, and the frame and tool in which it was taught."""

import csv
import io
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.intake.controllers import abb, fanuc, kuka, universal_robots, yaskawa
from stitch.plugins.intake.controllers.taught_points import TaughtPoint, line_of, program_text, without_comments
from stitch.session.reading.csv_files import is_number

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
PROGRAMS: dict[str, ModuleType] = {
    ".ls": fanuc,
    ".dat": kuka,
    ".src": kuka,
    ".mod": abb,
    ".script": universal_robots,
    ".jbi": yaskawa,
}
# Frame and tool of nothing: points taught in them are flange poses in the base.
NOTHING_IN_FORCE = ("UF 0, UT 0", "TOOL 0, BASE 0", "tool0, wobj0", "TOOL 0, BASE", "TOOL 0, ROBOT")
# No length in mm and no angle of a controller is larger.
_LARGEST = 1e9
_NAMES = {fanuc: "fanuc", kuka: "kuka", abb: "abb", universal_robots: "ur", yaskawa: "yaskawa"}
_COMMENTS = {kuka: ";", universal_robots: "#", abb: "!"}
# Programs are in mm; views.csv is in the session's length_unit.
_MM_IN_UNIT = {"mm": 1.0, "m": 1e-3}


def view_rows(
    points: Sequence[TaughtPoint], T_base_frame: Array, T_tool_flange: Array, scale: float
) -> list[list[str]]:
    """Return header and rows of views.csv; `scale` from mm to the session's unit. What a point lacks stays empty."""
    joints = max((len(p.joints) for p in points if p.joints is not None), default=0)
    posed = any(p.T_frame_tool is not None for p in points)
    rows = [["view", *(f"j{i + 1}_deg" for i in range(joints)), *(POSE_COLUMNS if posed else ())]]
    for name, point in zip(numbered_names(p.name for p in points), points, strict=True):
        row = [name]
        if joints:
            row += [""] * joints if point.joints is None else [f"{q:.9g}" for q in np.degrees(point.joints)]
        if posed:
            T = None if point.T_frame_tool is None else T_base_frame @ point.T_frame_tool @ T_tool_flange
            row += [""] * len(POSE_COLUMNS) if T is None else pose_cells(T, scale)
        rows.append(row)
    return rows


def pose_cells(T: Array, scale: float) -> list[str]:
    """Return position and quaternion of a pose (4, 4) as cells of a table."""
    return [*(f"{x * scale:.9g}" for x in T[:3, 3]), *(f"{q:.10f}" for q in frames.to_quaternion(T))]


def numbered_names(names: Iterable[str]) -> list[str]:
    """Return the names, numbered from the second on where one stands again."""
    out: list[str] = []
    taken: set[str] = set()
    for name in names:
        plain, k = name.strip() or "view", 1
        label = plain
        while label in taken:
            k += 1
            label = f"{plain}_{k}"
        taken.add(label)
        out.append(label)
    return out


def csv_text(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as the text of a CSV file."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue()


@dataclass(frozen=True)
class Program:
    """One program as it stands in its files."""

    file: Path
    controller: str  # kuka | fanuc | abb | ur | yaskawa
    points: tuple[TaughtPoint, ...]  # in the order of the file, each once
    texts: dict[Path, str]  # of the files that hold the points' numbers, byte for byte
    T_base_frame: Array  # (4, 4) mm
    T_flange_tool: Array  # (4, 4) mm
    repeated: tuple[str, ...] = ()  # points that are moved to more than once
    other: tuple[str, ...] = ()  # poses that are no targets: they stay
    unread: tuple[int, ...] = ()  # lines of motions whose targets are not read: they stay too


def read_program(file: Path, frame: str | None = None, tool: str | None = None, any_tool: bool = False) -> Program:
    """Read a program whose points are to be moved.

    Args:
        frame: T_base_frame in which the points were taught, numbers as the controller shows them.
        tool: T_flange_tool in force when they were taught, likewise.
        any_tool: nobody has to state it, since only the tool's own poses count.

    Raises:
        InputError: unknown or broken file, points of different frames, poses of an unknown frame or tool, an external
            axis that carries the arm.
        NoResultError: no points in the file.
    """
    reader = PROGRAMS.get(file.suffix.lower())
    if reader is None:
        raise InputError(f"{file}: unknown kind {file.suffix!r} of program; to fix: name one of {', '.join(PROGRAMS)}")
    if not file.is_file():
        raise InputError(f"{file}: no such file; to fix: name a program of the controller")
    text = program_text(file)
    told: list[TaughtPoint] = reader.read(file, text)
    every = [p for p in told if p.is_target]
    points = tuple({(p.file, p.pose_at, p.joints_at): p for p in every}.values())
    if not points:
        raise NoResultError(f"{file}: no taught points found; to fix: export the program with its positions")
    # A script of a UR has its poses in the base.
    needed = {"tool": tool} if reader is universal_robots else {"frame": frame, "tool": tool}
    _require_known_poses(
        file, points, [f"--{name}" for name in needed if needed[name] is None and not (any_tool and name == "tool")]
    )
    files = dict.fromkeys(p.file for p in points if p.file is not None)
    texts = {file: text} | {path: program_text(path) for path in files}
    times = Counter(p.name for p in every)
    mark = _COMMENTS.get(reader)
    code = text if mark is None else without_comments(text, mark)
    return Program(
        file,
        _NAMES[reader],
        points,
        texts,
        T_base_frame=stated_pose(reader.pose, "frame", frame),
        T_flange_tool=stated_pose(reader.pose, "tool", tool),
        repeated=tuple(p.name for p in points if times[p.name] > 1),
        other=tuple(p.name for p in told if not p.is_target),
        unread=tuple(line_of(text, m.start()) for m in reader.UNREAD.finditer(code)),
    )


def _require_known_poses(file: Path, points: Sequence[TaughtPoint], lacking: list[str]) -> None:
    """Refuse poses of a frame and a tool that nobody states, and those that an arm reaches on an external axis."""
    taught_in = require_one_frame(file, points)
    if lacking and taught_in is not None and taught_in not in NOTHING_IN_FORCE:
        known = f" ({taught_in})" if taught_in else ""
        raise InputError(
            f"{file}: its poses are those of a tool in a frame{known} that the file does not hold; to fix: state "
            f"{' and '.join(lacking)} as the controller shows them, zeros where none is in force"
        )
    moved = next((p for p in points if p.moved_by and p.T_frame_tool is not None), None)
    if moved is not None:
        raise InputError(
            f"{file} line {moved.line}: {moved.name} has {moved.moved_by}; where an external axis carries the arm its "
            "joint angles cannot be told; to fix: give joint targets"
        )


def stated_pose(pose: Callable[[Array], Array], name: str, value: str | None) -> Array:
    """Return (4, 4) mm of the numbers that a person states as the controller shows them; the unit matrix without any.

    Raises:
        InputError: too few numbers, or a quaternion that is none.
    """
    if value is None:
        return np.eye(4)
    count = 7 if pose is abb.pose else 6
    cells = value.split(",")
    if len(cells) != count or not all(is_number(cell) and abs(float(cell)) < _LARGEST for cell in cells):
        raise InputError(
            f"--{name} {value}: to fix: write {count} numbers with commas, as the controller shows the pose"
        )
    try:
        return pose(np.array([float(cell) for cell in cells]))
    except ValueError as error:
        raise InputError(f"--{name} {value}: {error}") from None


def require_one_frame(file: Path, points: Sequence[TaughtPoint]) -> str | None:
    """Return frame and tool of all poses as the file calls them, "" where it does not say of all; None without poses.

    Raises:
        InputError: points of different frames or tools.
    """
    posed = [point for point in points if point.T_frame_tool is not None]
    if not posed:
        return None
    told = [point for point in posed if point.frame]
    other = next((point for point in told if point.frame != told[0].frame), None)
    if other is not None:
        raise InputError(
            f"{file} line {other.line}: {other.name} is taught in {other.frame}, {told[0].name} in {told[0].frame}; "
            "to fix: give points of one frame and tool at a time"
        )
    return told[0].frame if len(told) == len(posed) else ""


@dataclass(frozen=True)
class ImportedTable:
    """A table of a session."""

    table: str  # "views.csv", "frames.csv" or "points.csv"
    text: str
    rows: int
    convention: str  # how the file writes orientations
    warnings: tuple[str, ...]


def import_file(file: Path, unit: str = "mm", frame: str | None = None, tool: str | None = None) -> ImportedTable:
    """Read a program.

    Args:
        unit: "mm" or "m", the session's length_unit.
        frame: T_base_frame in which the points were taught, numbers as the controller writes a pose.
        tool: T_flange_tool in force when they were taught, likewise. T_base_flange = frame · point · tool⁻¹.

    Raises:
        InputError: unknown or broken file, points of different frames; names the line and how to fix it.
        NoResultError: no points in the file.
    """
    if unit not in _MM_IN_UNIT:
        raise InputError(f"--unit {unit}: is no unit of a program; to fix: use mm or m")
    reader = PROGRAMS[file.suffix.lower()]
    text = file.read_text(encoding="utf-8-sig", errors="replace")
    if not text.strip():
        raise InputError(f"{file}: empty; to fix: export it again")
    points: Sequence[TaughtPoint] = reader.read(file, text)
    if not points:
        raise NoResultError(f"{file}: no taught points found; to fix: export the program with its positions")
    warnings = _check_frames(file, points, frame, tool)
    T_base_frame, T_flange_tool = stated_pose(reader.pose, "frame", frame), stated_pose(reader.pose, "tool", tool)
    rows = view_rows(points, T_base_frame, frames.inverse(T_flange_tool), _MM_IN_UNIT[unit])
    return ImportedTable("views.csv", csv_text(rows), len(points), reader.CONVENTION, warnings)


def _check_frames(file: Path, points: Sequence[TaughtPoint], frame: str | None, tool: str | None) -> tuple[str, ...]:
    """Refuse points of several frames and tools; return a warning where poses need them and none was given."""
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
