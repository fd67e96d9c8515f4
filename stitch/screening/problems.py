"""Problems of a session in words: their kind, size and views, and what to do."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stitch.numerics.units import angle_text, length_text
from stitch.observations.pose_errors import usual_twist

# Rotation (rad) and shift (length_unit).
DisplacementSize = tuple[float, float]

# Digits that are known of a displacement.
_DIGITS = 2
# Names or ranges that a message lists, and how many views in a row make a range.
_LISTED, _RANGE = 6, 3


@dataclass(frozen=True)
class SessionProblem:
    """A problem of a session, its views and its remedy; no views where it concerns the whole session."""

    # exchanged | shifted | reversed | inverse | mount | euler | degrees | quaternion | unit | scale | mirrored |
    # linear_axis | joint_sign | joint_coupling | joint_row | duplicate_scan | duplicate_pose | displaced | foreign |
    # reclamped | disconnected
    kind: str
    views: tuple[str, ...]
    fix: str  # one line
    certain: bool = True  # False: a hint that the numbers do not prove
    mistake: str = ""  # its name in the list of `hypotheses`

    def as_dict(self) -> dict[str, Any]:
        """Return it as `stitch check --deep --json` prints it."""
        return {"kind": self.kind, "views": list(self.views), "fix": self.fix}

    def line(self, order: Sequence[str]) -> str:
        """Return it as a message: kind, views, what and how to fix; `order` has the names of all views."""
        where = f" ({list_views(self.views, order)})" if self.views else ""
        return f"{self.kind}{where}: {self.fix}"


def displacement_text(best: DisplacementSize, least: DisplacementSize, length_unit: str) -> str:
    """Return a displacement in words: its estimate, or "at least" and its lower bound where these differ as printed.

    A rotation or shift whose bound is within the usual repeatability of arms is left out; "" if both are.

    Args:
        best, least: the estimate and the smallest displacement that the evidence admits: rotation (rad) and shift
            (length_unit).
    """
    usual_angle, usual_length = usual_twist(length_unit)[[0, 3]]

    def text(rotation: float, shift: float) -> str:
        """Return a rotation (rad) and a shift (length_unit) in words; none whose bound is within what arms repeat."""
        parts = []
        if least[1] > usual_length:
            parts.append(length_text(shift, length_unit, _DIGITS))
        if least[0] > usual_angle:
            degrees = float(np.degrees(rotation))
            in_degrees = f"{degrees:.{0 if degrees >= 10 else 1}f}°"
            parts.append(in_degrees if degrees > 1 else angle_text(rotation, _DIGITS))
        return " and ".join(parts)

    lower = text(*least)
    if not lower or lower == text(*best):
        return lower
    return f"at least {lower}"


def list_views(names: Sequence[str], order: Sequence[str]) -> str:
    """Return the names of views, the first few and neighbours as a range: "v000–v102, v105 … and 97 more".

    Args:
        order: names of all views as they follow each other in the session.
    """
    place = {name: at for at, name in enumerate(order)}
    rows = list[list[str]]()
    for name in names:
        follows = rows and name in place and place.get(rows[-1][-1]) == place[name] - 1
        rows[-1].append(name) if follows else rows.append([name])
    parts = [part for row in rows for part in ([row] if len(row) >= _RANGE else [[name] for name in row])]
    listed = ", ".join(f"{part[0]}–{part[-1]}" if len(part) > 1 else part[0] for part in parts[:_LISTED])
    rest = sum(map(len, parts[_LISTED:]))
    return listed + (f" … and {rest} more" if rest else "")


def likeliest_text(fixes: Sequence[str]) -> str:
    """Return the likeliest explanation, followed by up to two others that are as likely."""
    return "; or, as likely: ".join([*dict.fromkeys(fixes)][:3])
