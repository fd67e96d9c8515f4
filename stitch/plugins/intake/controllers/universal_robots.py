"""Universal Robots: .script programs and .csv recordings (RTDE). Rotation vectors; m and rad.

In a script, points are written into movej, movel, movep or movec, or into variables; PolyScript writes a
waypoint as NAME_p (pose) and NAME_q (joints), which become one point. Poses are those of the TCP.
"""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.plugins.intake.controllers.taught_points import (
    CELL,
    TaughtPoint,
    line_of,
    rotation_vector,
    without_comments,
)
from stitch.session.reading.csv_files import finite_number, is_number

CONVENTION = "rotation vector rx, ry, rz in rad; m (written as mm)"
pose = rotation_vector

_LIST = r"(p?)\[([^\[\]]*)\]"
_NAMED = re.compile(rf"\b(\w+)\s*=\s*{_LIST}")
_MOVE = re.compile(rf"\bmove[jlpc]\s*\(\s*{_LIST}")
# Arcs, whose second pose is not read, and targets that are computed in the call.
UNREAD = re.compile(r"\bmove(?:c\s*\(|[jlp]\s*\(\s*\w+\s*\()")
_USED = re.compile(r"\bmove[jlpc]\s*\(([^\n]*)")
_POSE = tuple([f"{kind}_TCP_pose_{i}" for i in range(6)] for kind in ("actual", "target"))
_JOINTS = tuple([f"{kind}_q_{i}" for i in range(6)] for kind in ("actual", "target"))


def read(file: Path, text: str) -> list[TaughtPoint]:
    """Return the points of a .script, or one per row of a .csv.

    Raises:
        InputError: names the line and how to fix it.
    """
    return _read_recording(file, text) if file.suffix.lower() == ".csv" else _read_script(file, text)


def _read_script(file: Path, text: str) -> list[TaughtPoint]:
    clean = without_comments(text, "#")
    found = [(m.start(), m[1], m[2], m.span(3)) for m in _NAMED.finditer(clean)]
    found += [(m.start(), f"line{line_of(text, m.start())}", m[1], m.span(2)) for m in _MOVE.finditer(clean)]
    points: dict[str, TaughtPoint] = {}
    for position, name, kind, (begin, end) in sorted(found):
        spans = tuple((begin + m.start(), begin + m.end()) for m in CELL.finditer(clean[begin:end]))
        cells = [clean[slice(*span)] for span in spans]
        line = line_of(text, position)
        if len(cells) != 6:
            if kind:
                raise InputError(f"{file} line {line}: {name} has {len(cells)} numbers; to fix: a pose p[…] takes six")
            continue  # A list of something else: a payload, a vector, an I/O pattern.
        if not all(is_number(cell) for cell in cells):
            if name != f"line{line}":
                continue  # Computed while the program runs: no taught point.
            raise InputError(
                f"{file} line {line}: the target is computed while the program runs; to fix: write its numbers"
            )
        values = np.array([float(cell) for cell in cells])
        base = re.sub(r"_[pq]$", "", name)
        before = points.get(base, TaughtPoint(base, line, None, None))
        if kind:
            points[base] = replace(before, T_frame_tool=rotation_vector(values), pose_at=spans)
        else:
            points[base] = replace(before, joints=values, joints_at=spans)
    used = {name for m in _USED.finditer(clean) for name in re.findall(r"\w+", m[1])}
    # A pose that no motion names is a tool or a plane.
    return [
        replace(p, is_target=p.name.startswith("line") or not used.isdisjoint({p.name, f"{p.name}_p", f"{p.name}_q"}))
        for p in points.values()
    ]


def is_recording(text: str) -> bool:
    """Return whether a text is a robot's recording: a header with a pose or joints under one of the known names."""
    first = text.lstrip().splitlines()[0]
    header = [cell.strip() for cell in first.split(_separator(first))]
    return any(all(name in header for name in names) for names in (*_POSE, *_JOINTS))


def _read_recording(file: Path, text: str) -> list[TaughtPoint]:
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    separator = _separator(lines[0][1])
    rows = list(csv.reader([line for _, line in lines], delimiter=separator, skipinitialspace=True))
    header = [name.strip() for name in rows[0]]
    pose, joints = (next((c for c in choice if all(n in header for n in c)), None) for choice in (_POSE, _JOINTS))
    out = []
    for (line, _), row in zip(lines[1:], rows[1:], strict=True):
        if len(row) < len(header):
            raise InputError(
                f"{file} line {line}: {len(row)} cells, the header has {len(header)}; to fix: correct the line"
            )
        cells = dict(zip(header, row, strict=False))
        T = None if pose is None else rotation_vector(_row_values(file, line, cells, pose))
        out.append(
            TaughtPoint(f"row{line}", line, T, None if joints is None else _row_values(file, line, cells, joints))
        )
    return out


def _separator(header: str) -> str:
    return next((s for s in ",;\t" if s in header), " ")


def _row_values(file: Path, line: int, cells: dict[str, str], names: list[str]) -> Array:
    return np.array([finite_number(file, line, name, cells[name]) for name in names])
