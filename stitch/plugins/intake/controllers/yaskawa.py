"""Yaskawa .jbi jobs: the positions under //POS, as poses (RECTAN) or joint angles (ANGLE).

Rx, Ry, Rz turn about the fixed x, y, z. Pulses are not read: what a pulse turns depends on the arm's gears.
"""

import re
from pathlib import Path

from stitch.errors import InputError
from stitch.plugins.intake.controllers.taught_points import TaughtPoint, WrittenNumber, fixed_xyz, line_of, taught_point
from stitch.session.reading.csv_files import finite_number

CONVENTION = "Rx, Ry, Rz in degrees about fixed x, y, z: Rz(Rz)·Ry(Ry)·Rx(Rx); mm"
pose = fixed_xyz

# A position, or what holds for those behind it.
_LINE = re.compile(r"^(?:///(TOOL|USER|POSTYPE)\s+(\w+)|(C|P)(\d+)=([^\n]*))", re.M)
_CELL = re.compile(r"[^,\s]+")
_AXES = "XYZUVW"
# Arcs and splines.
UNREAD = re.compile(r"^[ \t]*MOV[CS]\b", re.M)


def read(file: Path, text: str) -> list[TaughtPoint]:
    """Return the positions of one job in the order of the file.

    Raises:
        InputError: no //POS section, a position in pulses or with too few numbers.
    """
    start, end = text.find("//POS"), text.find("//INST")
    if start < 0:
        raise InputError(f"{file}: no //POS section; to fix: save the job with its positions")
    in_force = {"TOOL": "0", "USER": "", "POSTYPE": "PULSE"}
    points = []
    for match in _LINE.finditer(text, start, end if end > start else len(text)):
        if match[1]:
            in_force[match[1]] = match[2]
            continue
        points.append(_point(file, text, match, in_force))
    return points


def _point(file: Path, text: str, match: re.Match[str], in_force: dict[str, str]) -> TaughtPoint:
    name, line, kind = f"{match[3]}{match[4]}", line_of(text, match.start()), in_force["POSTYPE"]
    if kind == "PULSE":
        raise InputError(
            f"{file} line {line}: {name} is in pulses; to fix: save the job as a relative one, with ///POSTYPE BASE"
        )
    cells = [
        WrittenNumber(
            finite_number(file, line, name, cell[0]), (match.start(5) + cell.start(), match.start(5) + cell.end())
        )
        for cell in _CELL.finditer(match[5])
    ]
    names = [f"J{i}" for i in range(1, len(cells) + 1)] if kind == "ANGLE" else list(_AXES)
    of_user = f" {in_force['USER']}" if kind == "USER" else ""
    fields = dict(zip(names, cells, strict=False))
    frame = "" if kind == "ANGLE" else f"TOOL {in_force['TOOL']}, {kind}{of_user}"
    point = taught_point(name, line, fields, _AXES, fixed_xyz, joint="J", frame=frame)
    if point is None:
        raise InputError(f"{file} line {line}: {name} has {len(cells)} numbers; to fix: write X, Y, Z, Rx, Ry, Rz")
    return point
