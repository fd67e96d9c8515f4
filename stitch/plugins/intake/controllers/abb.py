"""ABB RAPID .mod: robtargets and jointtargets, declared or written into a move. Quaternions with w first."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.plugins.intake.controllers.taught_points import (
    CELL,
    TaughtPoint,
    WrittenNumber,
    line_of,
    quaternion_w_first,
)
from stitch.session.reading.csv_files import finite_number

CONVENTION = "quaternion q1, q2, q3, q4 with q1 = w; mm"
pose = quaternion_w_first

_DECLARED = re.compile(r"\b(robtarget|jointtarget)\s+(\w+)\s*(?:\{\s*\d+\s*\})?\s*:=\s*([^;]*);", re.I)
_MOVE = re.compile(r"\bMove(L|J|AbsJ)\s+(\[[^;]*?\]\s*\])\s*(?:\\|,)", re.I)
# Arcs to targets that are written into the motion.
UNREAD = re.compile(r"\bMoveC\s+[^;]*\[[^;]*;", re.I)
_TARGET = re.compile(r"\[((?:[^\[\]]*\[[^\[\]]*\]){2,4})[^\[\]]*\]")
_LIST = re.compile(r"\[([^\[\]]*)\]")

# Tool and work object are the last words of a move.
_USED = re.compile(r"\bMove[LJ]\s+(\w+|\[[^;]*\])[^;]*,\s*(\w+)\s*(?:\\WObj\s*:=\s*(\w+))?\s*;", re.I)
# What stands for an external axis that there is not: 9E9.
_NONE = 8e9


def read(file: Path, text: str) -> list[TaughtPoint]:
    """Return targets in the order of the file; arrays give one point per element.

    Raises:
        InputError: a target without numbers or with a quaternion that is none.
    """
    # Comments run from an exclamation mark, outside strings, to the end of the line; lengths stay.
    clean = re.sub(r'"[^"\n]*"|![^\n]*', lambda m: m[0] if m[0].startswith('"') else " " * len(m[0]), text)
    found: list[tuple[int, TaughtPoint]] = []
    for match in _DECLARED.finditer(clean):
        found += _targets(file, text, match.start(3), match[2], match[3], match[1].lower() == "jointtarget")
    for match in _MOVE.finditer(clean):
        name = f"line{line_of(text, match.start())}"
        found += _targets(file, text, match.start(2), name, match[2], match[1].lower() == "absj")
    frames = _frames(clean, text)
    return [replace(point, frame=frames.get(point.name, "")) for _, point in sorted(found, key=lambda pair: pair[0])]


def _frames(clean: str, text: str) -> dict[str, str]:
    """Return tool and work object by the name of a point; empty for one that is used with several."""
    used: dict[str, set[str]] = {}
    for m in _USED.finditer(clean):
        name = f"line{line_of(text, m.start())}" if m[1].startswith("[") else m[1]
        used.setdefault(name, set()).add(f"{m[2]}, {m[3] or 'wobj0'}")
    return {name: told.pop() if len(told) == 1 else "" for name, told in used.items()}


def _targets(file: Path, text: str, at: int, name: str, value: str, joint: bool) -> list[tuple[int, TaughtPoint]]:
    matches = list(_TARGET.finditer(value))
    line = line_of(text, at)
    if not matches:
        raise InputError(f"{file} line {line}: {name} is not written as [[…],[…],…]; to fix: write its numbers out")
    names = [name] if len(matches) == 1 else [f"{name}_{k + 1}" for k in range(len(matches))]
    return [
        (at + m.start(), _point(file, line_of(text, at + m.start()), label, m[1], at + m.start(1), joint=joint))
        for m, label in zip(matches, names, strict=True)
    ]


def _point(file: Path, line: int, name: str, body: str, begin: int, *, joint: bool) -> TaughtPoint:
    """Return a point from its lists, which stand at `begin`."""
    lists = [
        [
            WrittenNumber(
                finite_number(file, line, name, cell[0]),
                (begin + part.start(1) + cell.start(), begin + part.start(1) + cell.end()),
            )
            for cell in CELL.finditer(part[1])
        ]
        for part in _LIST.finditer(body)
    ]
    values, spans = [[w.value for w in own] for own in lists], [tuple(w.span for w in own) for own in lists]
    if joint and len(lists[0]) == 6:
        return TaughtPoint(name, line, None, np.radians(values[0]), joints_at=spans[0])
    if not joint and len(lists[0]) == 3 and len(lists[1]) == 4:
        try:
            T_frame_tool = quaternion_w_first(np.array(values[0] + values[1]))
        except ValueError as error:
            raise InputError(f"{file} line {line}: {name}: {error}") from None
        axes = [f"eax_{letter} {x:g}" for letter, x in zip("abcdef", values[-1], strict=False) if x and x < _NONE]
        moved_by = ", ".join(axes) if len(values) == 4 else ""
        return TaughtPoint(name, line, T_frame_tool, None, pose_at=spans[0] + spans[1], moved_by=moved_by)
    raise InputError(
        f"{file} line {line}: {name} is no target; to fix: write [[x,y,z],[q1,q2,q3,q4],…] or [[j1 … j6],…]"
    )
