"""FANUC .ls listings: the /POS section, GP1 of every P[n]. W, P, R are fixed XYZ angles.

J3 is written as the controller shows it, measured from the horizontal and not from the lower arm: the
DH joint 3 of most published tables is J2 + J3.
"""

import re
from pathlib import Path

from stitch.errors import InputError
from stitch.plugins.intake.controllers.taught_points import TaughtPoint, WrittenNumber, fixed_xyz, line_of, taught_point
from stitch.session.reading.csv_files import finite_number

CONVENTION = "W, P, R in degrees about fixed x, y, z: Rz(R)·Ry(P)·Rx(W); mm"
pose = fixed_xyz

_POINT = re.compile(r"P\[(\d+)(?:\s*:\s*\"([^\"]*)\")?\]\s*\{(.*?)\}\s*;", re.S)
_GROUP = re.compile(r"GP1\s*:(.*?)(?=GP\d+\s*:|\Z)", re.S)
# Motions to position registers, which a listing does not hold, and along arcs to them.
UNREAD = re.compile(r"^[ \t]*\d+:\s*[JLCA]\s+PR\[", re.M)
_FRAME = re.compile(r"UF\s*:\s*(\w+)\s*,\s*UT\s*:\s*(\w+)")
# Numbers, or the stars of a point that was never taught.
_FIELD = re.compile(r"\b([XYZWPR]|[JE]\d)\s*=\s*([-+.\deE*]+)")
_DECIMAL_COMMA = re.compile(r"=\s*([-+]?\d+,\d+)")


def read(file: Path, text: str) -> list[TaughtPoint]:
    """Return the points of one listing.

    Raises:
        InputError: no /POS section, a point without numbers.
    """
    start = text.find("/POS")
    if start < 0:
        raise InputError(f"{file}: no /POS section; to fix: save the program as an .LS listing with its positions")
    return [_point(file, text, match) for match in _POINT.finditer(text, start)]


def _point(file: Path, text: str, match: re.Match[str]) -> TaughtPoint:
    index, comment, body = match.groups()
    line, name = line_of(text, match.start()), comment or f"P{index}"
    group = _GROUP.search(body)
    if group is None:
        raise InputError(f"{file} line {line}: P[{index}] has no GP1; to fix: teach it in the arm's own group")
    if (cut := _DECIMAL_COMMA.search(group[1])) is not None:
        raise InputError(f"{file} line {line}: P[{index}] has {cut[1]!r}; to fix: write decimals with a point")
    begin = match.start(3) + group.start(1)
    fields = {
        m[1]: WrittenNumber(
            finite_number(file, line, f"P[{index}] {m[1]}", m[2], "teach the point or remove it"),
            (begin + m.start(2), begin + m.end(2)),
        )
        for m in _FIELD.finditer(group[1])
    }
    taught_in = _FRAME.search(group[1])
    frame = f"UF {taught_in[1]}, UT {taught_in[2]}" if taught_in else ""
    point = taught_point(name, line, fields, "XYZWPR", fixed_xyz, joint="J", frame=frame)
    if point is None:
        raise InputError(f"{file} line {line}: P[{index}] has neither X … R nor J1 … J6; to fix: teach it again")
    return point
