"""A robot program with the places of its numbers, and the frame and tool in which it was taught."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from stitch.controllers import abb, fanuc, kuka, universal
from stitch.controllers.taught import TaughtPoint, line_of, program_text, without_comments
from stitch.errors import InputError, NoResultError
from stitch.frames import Array
from stitch.reading.csv_number import is_number

PROGRAMS: dict[str, ModuleType] = {
    ".ls": fanuc,
    ".dat": kuka,
    ".src": kuka,
    ".mod": abb,
    ".script": universal,
}
# Frame and tool of nothing: points taught in them are flange poses in the base.
NOTHING_IN_FORCE = ("UF 0, UT 0", "TOOL 0, BASE 0", "tool0, wobj0")
# No length in mm and no angle of a controller is larger.
_LARGEST = 1e9
_NAMES = {fanuc: "fanuc", kuka: "kuka", abb: "abb", universal: "ur"}


@dataclass(frozen=True)
class Program:
    """One program as it stands in its files."""

    file: Path
    controller: str  # kuka | fanuc | abb | ur
    points: tuple[TaughtPoint, ...]  # in the order of the file, each once
    texts: dict[Path, str]  # of the files that hold the points' numbers, byte for byte
    T_base_frame: Array  # (4, 4) mm
    T_flange_tool: Array  # (4, 4) mm
    repeated: tuple[str, ...] = ()  # points that are moved to more than once
    other: tuple[str, ...] = ()  # poses that are no targets: they stay
    unread: tuple[int, ...] = ()  # lines of motions whose targets are not read: they stay too


def read_program(file: Path, frame: str | None = None, tool: str | None = None) -> Program:
    """Read a program whose points are to be moved.

    Args:
        frame: T_base_frame in which the points were taught, numbers as the controller shows them.
        tool: T_flange_tool in force when they were taught, likewise.

    Raises:
        InputError: unknown or broken file, points of different frames, poses of an unknown frame or tool, an external
            axis that carries the arm.
        NoResultError: no points in the file.
    """
    reader = PROGRAMS.get(file.suffix.lower())
    if reader is None:
        raise InputError(f"{file}: unknown kind {file.suffix!r} of program; known are {', '.join(PROGRAMS)}")
    if not file.is_file():
        raise InputError(f"{file}: no such file; to fix: name a program of the controller")
    text = program_text(file)
    told: list[TaughtPoint] = reader.read(file, text)
    every = [p for p in told if p.is_target]
    points = tuple({(p.file, p.pose_at, p.joints_at): p for p in every}.values())
    if not points:
        raise NoResultError(f"{file}: no taught points found; export the program with its positions")
    # A script of a UR has its poses in the base.
    needed = {"tool": tool} if reader is universal else {"frame": frame, "tool": tool}
    _require_stated(file, require_one_frame(file, points), [f"--{name}" for name in needed if needed[name] is None])
    _require_own_motion(file, points)
    files = dict.fromkeys(p.file for p in points if p.file is not None)
    texts = {file: text} | {path: program_text(path) for path in files}
    times = Counter(p.name for p in every)
    return Program(
        file,
        _NAMES[reader],
        points,
        texts,
        T_base_frame=stated_pose(reader.pose, "frame", frame),
        T_flange_tool=stated_pose(reader.pose, "tool", tool),
        repeated=tuple(p.name for p in points if times[p.name] > 1),
        other=tuple(p.name for p in told if not p.is_target),
        unread=tuple(line_of(text, m.start()) for m in reader.UNREAD.finditer(_without_comments(reader, text))),
    )


def _require_stated(file: Path, taught_in: str | None, lacking: list[str]) -> None:
    """Refuse poses of a frame and a tool that nobody states."""
    if taught_in is None or taught_in in NOTHING_IN_FORCE or not lacking:
        return
    known = f" ({taught_in})" if taught_in else ""
    raise InputError(
        f"{file}: its poses are those of a tool in a frame{known} that the file does not hold; to fix: state "
        f"{' and '.join(lacking)} as the controller shows them, zeros where none is in force"
    )


def _require_own_motion(file: Path, points: Sequence[TaughtPoint]) -> None:
    """Refuse poses that an arm reaches on an external axis."""
    moved = next((p for p in points if p.moved_by and p.T_frame_tool is not None), None)
    if moved is not None:
        raise InputError(
            f"{file} line {moved.line}: {moved.name} has {moved.moved_by}; where an external axis carries the arm its "
            "joint angles cannot be told; to fix: give joint targets"
        )


def _without_comments(reader: ModuleType, text: str) -> str:
    """The text without comments; lengths stay."""
    mark = {kuka: ";", universal: "#", abb: "!"}.get(reader)
    return text if mark is None else without_comments(text, mark)


def stated_pose(pose: Callable[[Array], Array], name: str, value: str | None) -> Array:
    """(4, 4) mm of the numbers that a person states as the controller shows them; the unit matrix without any.

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
    """Frame and tool of all poses as the file calls them, "" where it does not say of all; None without poses.

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
