"""Universal Robots: .script programs. Rotation vectors; m and rad.

In a script, points are written into movej, movel, movep or movec, or into variables; PolyScript writes a
waypoint as NAME_p (pose) and NAME_q (joints), which become one point. Poses are those of the TCP.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.plugins.intake.controllers.taught_points import (
    CELL,
    TaughtPoint,
    line_of,
    rotation_vector,
    without_comments,
)
from stitch.session.reading.csv_files import is_number

CONVENTION = "rotation vector rx, ry, rz in rad; m (written as mm)"
pose = rotation_vector

_LIST = r"(p?)\[([^\[\]]*)\]"
_NAMED = re.compile(rf"\b(\w+)\s*=\s*{_LIST}")
_MOVE = re.compile(rf"\bmove[jlpc]\s*\(\s*{_LIST}")
# Arcs, whose second pose is not read, and targets that are computed in the call.
UNREAD = re.compile(r"\bmove(?:c\s*\(|[jlp]\s*\(\s*\w+\s*\()")
_USED = re.compile(r"\bmove[jlpc]\s*\(([^\n]*)")


def read(file: Path, text: str) -> list[TaughtPoint]:
    """Return the points of a script.

    Raises:
        InputError: names the line and how to fix it.
    """
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
