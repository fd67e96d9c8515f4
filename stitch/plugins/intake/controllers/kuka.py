"""KUKA .dat and .src: E6POS, POS, FRAME, E6AXIS and AXIS. A, B, C turn about z, then y, then x.

A .src gives the points in the order of its motions; names in it are looked up in the .dat beside it.
"""

import re
from dataclasses import replace
from pathlib import Path

from stitch.errors import InputError
from stitch.plugins.intake.controllers.taught_points import (
    TaughtPoint,
    WrittenNumber,
    line_of,
    program_text,
    taught_point,
    without_comments,
    zyx,
)
from stitch.session.reading.csv_files import finite_number

CONVENTION = "A, B, C in degrees about z, new y, new x: Rz(A)·Ry(B)·Rx(C); mm"
pose = zyx

_DECLARED = re.compile(
    r"^[ \t]*(?:GLOBAL\s+)?(?:DECL\s+)?(?:GLOBAL\s+)?(E6POS|POS|FRAME|E6AXIS|AXIS)\s+(\w+)\s*=\s*\{(.*?)\}",
    re.M | re.I | re.S,
)
# Tool and base of a point XP1 stand in FP1.
_IN_FORCE = re.compile(r"\bFDAT\s+F(\w+)\s*=\s*\{[^}]*?\bTOOL_NO\s+(\d+)[^}]*?\bBASE_NO\s+(\d+)", re.I)
_MOTION = re.compile(r"^[ \t]*S?(?:PTP|LIN)(?:_REL)?\s+(?:(\w+)|\{(.*?)\})", re.M | re.I)
# Motions whose targets are not read.
UNREAD = re.compile(r"^[ \t]*S?(?:CIRC|SPL)(?:_REL)?\s+[\w{]", re.M | re.I)
# A motion to an aggregate that its line does not close.
_OPEN = re.compile(r"^[ \t]*S?(?:PTP|LIN)(?:_REL)?\s+\{[^}\n]*$", re.M | re.I)
# A field of an aggregate: X 1200.5, S 2, or with the aggregate's type before it, E6POS: X 1200.5.
_CELL = re.compile(r"\s*(?:\w+\s*:)?\s*\w+\s+\S+\s*")
_FIELD = re.compile(r"\b([XYZABC]|[AE]\d)\s+([^,}\s]+)", re.I)


def read(file: Path, text: str) -> list[TaughtPoint]:
    """Return the points of a .dat (as declared) or a .src (as moved to).

    Raises:
        InputError: a point without numbers or with a brace that stays open, a name that is declared nowhere.
    """
    if file.suffix.lower() == ".dat":
        return list(_declared_points(file, text).values())
    known = _declared_points(file, text)
    data = next((p for p in (file.with_suffix(".dat"), file.with_suffix(".DAT")) if p.is_file()), None)
    if data is not None:
        told = _declared_points(data, program_text(data))
        known |= {name: replace(point, file=data) for name, point in told.items()}
    clean = without_comments(text, ";")
    if (left := _OPEN.search(clean)) is not None:
        raise InputError(f"{file} line {line_of(text, left.start())}: a brace stays open; to fix: close it on its line")
    return [_motion_target(file, text, match, known) for match in _MOTION.finditer(clean)]


def _declared_points(file: Path, text: str) -> dict[str, TaughtPoint]:
    clean = without_comments(text, ";")
    found = [
        (m[2], m[1], _point(file, m[2], line_of(text, m.start(2)), m[3], m.start(3))) for m in _DECLARED.finditer(clean)
    ]
    frames = {f"X{m[1]}".upper(): f"TOOL {m[2]}, BASE {m[3]}" for m in _IN_FORCE.finditer(clean)}
    return {
        name.upper(): replace(point, frame=frames.get(name.upper(), ""), is_target=kind.upper() != "FRAME")
        for name, kind, point in found
    }


def _motion_target(file: Path, text: str, match: re.Match[str], known: dict[str, TaughtPoint]) -> TaughtPoint:
    line = line_of(text, match.start(1) if match[1] else match.start(2))
    if "_REL" in match[0].upper():
        raise InputError(
            f"{file} line {line}: a relative motion has no pose of its own; to fix: give the point as E6POS"
        )
    if match[2]:
        return _point(file, f"line{line}", line, match[2], match.start(2))
    if match[1].upper() not in known:
        raise InputError(
            f"{file} line {line}: {match[1]} is declared nowhere; to fix: put {file.stem}.dat beside the .src"
        )
    return replace(known[match[1].upper()], is_target=True)


def _point(file: Path, name: str, line: int, body: str, begin: int) -> TaughtPoint:
    """Return a point from the fields between its braces, which stand at `begin`."""
    odd = next((cell for cell in body.split(",") if not _CELL.fullmatch(cell)), None)
    if odd is not None:
        raise InputError(
            f"{file} line {line}: {name} has {odd.strip()!r} between its commas; to fix: write name and number, "
            "decimals with a point"
        )
    fields = {
        m[1].upper(): WrittenNumber(
            finite_number(file, line, f"{name} {m[1].upper()}", m[2]), (begin + m.start(2), begin + m.end(2))
        )
        for m in _FIELD.finditer(body)
    }
    point = taught_point(name, line, fields, "XYZABC", zyx, joint="A")
    if point is None:
        raise InputError(
            f"{file} line {line}: {name} has neither X, Y, Z, A, B, C nor A1 … A6; to fix: write all of them"
        )
    return point
