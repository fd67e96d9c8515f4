"""By what a cell is known again: names of arm and scanner, and the arm's DH rows, as session.toml states them."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from stitch.numerics.units import METRES

_ROW = ("a", "alpha_deg", "d", "theta_deg")
# A calibrated arm differs from its data sheet by less than this (mm, degrees); another arm by more in some row.
_LENGTH, _ANGLE = 10.0, 2.0


def cell_identity(session: Path) -> dict[str, Any]:
    """Return what session.toml states of arm and scanner; {} where there is none, or where it states nothing."""
    try:
        document = tomllib.loads((session / "session.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    robot, scanner = document.get("robot", {}), document.get("scanner", {})
    rows = [[float(joint.get(key, 0.0)) for key in _ROW] for joint in robot.get("joints", [])]
    stated = {"arm": robot.get("name"), "scanner": scanner.get("name"), "rows": rows}
    return {key: value for key, value in stated.items() if value}


def other_cell(known: dict[str, Any], told: dict[str, Any], length_unit: str) -> str | None:
    """Return by what a session is of another cell, in words; None where both could be one."""
    for key in ("arm", "scanner"):
        if key in known and key in told and known[key] != told[key]:
            return f"has {key} {told[key]}, the cell {known[key]}"
    if "rows" in known and "rows" in told:
        if len(known["rows"]) != len(told["rows"]):
            return f"has an arm of {len(told['rows'])} joints, the cell one of {len(known['rows'])}"
        in_mm = METRES.get(length_unit, 1e-3) * 1e3
        limits = np.array([_LENGTH / in_mm, _ANGLE, _LENGTH / in_mm, _ANGLE])
        off = np.abs(np.array(told["rows"]) - np.array(known["rows"])) / limits
        if off.max() > 1:
            return f"has other DH rows than the cell (joint {int(off.max(axis=1).argmax()) + 1} first of all)"
    return None
