"""One mistake of a session: its kind, the views it concerns and what to do."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stitch.observations.pose_errors import usual_twist
from stitch.units import angle_text, length_text

# How far views are off, in words: no more than their surfaces tell, and nothing of what arms do anyway.

# That are known of a displacement.
_DIGITS = 2

# Rotation (rad) and shift (length_unit).
DisplacementSize = tuple[float, float]


def displacement_text(best: DisplacementSize, least: DisplacementSize, length_unit: str) -> str:
    """A displacement: its best estimate, or the least that is likely where surfaces hold it no better; "" for nothing
    that poses of arms do not differ by too.

    Args:
        best, least: that displacement, and the smallest one that the evidence admits.
    """
    told = _significant_displacement(best, least, length_unit)
    if told and told == _significant_displacement(least, least, length_unit):
        return told
    least_told = _significant_displacement(least, least, length_unit)
    return f"at least {least_told}" if least_told else ""


def _significant_displacement(size: DisplacementSize, least: DisplacementSize, length_unit: str) -> str:
    """What is surely more than arms repeat by."""
    angle, length = usual_twist(length_unit)[[0, 3]]
    parts = [length_text(size[1], length_unit, _DIGITS)] if least[1] > length else []
    return " and ".join([*parts, angle_in_words(size[0])] if least[0] > angle else parts)


def angle_in_words(angle: float) -> str:
    """In mrad, or in degrees where it is more than one."""
    degrees = float(np.degrees(angle))
    return f"{degrees:.{0 if degrees >= 10 else 1}f}°" if degrees > 1 else angle_text(angle, _DIGITS)


# Names of views in a message: the first few, and those that follow each other in the session as a range.

# Names or ranges that a message lists, and how many views in a row make a range.
_LISTED, _RANGE = 6, 3


def list_views(names: Sequence[str], order: Sequence[str]) -> str:
    """Some views in words: "v000–v102, v105 … and 97 more".

    Args:
        order: names of all views as they follow each other in the session.
    """
    place = {name: at for at, name in enumerate(order)}
    rows = list[list[str]]()
    for name in names:
        follows = rows and name in place and place.get(rows[-1][-1]) == place[name] - 1
        rows[-1].append(name) if follows else rows.append([name])
    said = [part for row in rows for part in ([row] if len(row) >= _RANGE else [[name] for name in row])]
    shown = ", ".join(f"{part[0]}–{part[-1]}" if len(part) > 1 else part[0] for part in said[:_LISTED])
    rest = sum(map(len, said[_LISTED:]))
    return shown + (f" … and {rest} more" if rest else "")


def likeliest_text(fixes: Sequence[str]) -> str:
    """Return the likeliest explanation, followed by up to two others that are as likely."""
    return "; or, as likely: ".join([*dict.fromkeys(fixes)][:3])


@dataclass(frozen=True)
class SessionProblem:
    """What is wrong, where, and how to put it right; `views` is empty where it concerns the whole session."""

    # exchanged | shifted | reversed | inverse | mount | euler | degrees | quaternion | unit | scale | mirrored |
    # joint_row | duplicate_scan | duplicate_pose | displaced | foreign | reclamped | disconnected
    kind: str
    views: tuple[str, ...]
    fix: str  # one line
    certain: bool = True  # False: a hint that the numbers do not prove

    def as_dict(self) -> dict[str, Any]:
        """As `stitch check --deep --json` prints it."""
        return {"kind": self.kind, "views": list(self.views), "fix": self.fix}

    def line(self, order: Sequence[str]) -> str:
        """As a message: kind, views, to fix; with the names of all views as they follow each other."""
        where = f" ({list_views(self.views, order)})" if self.views else ""
        return f"{self.kind}{where}: {self.fix}"
