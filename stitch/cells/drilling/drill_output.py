"""What a drilling job found, as a document and as a table that a person or a controller can read."""

from pathlib import Path
from typing import Any

import numpy as np

from stitch.cells.drilling.compensation import GroupCompensation
from stitch.cells.drilling.drill_solution import DrillResult, Drive
from stitch.cells.drilling.tool_axis import ToolAxis
from stitch.cells.pose_table import write_columns


def write_drives(result: DrillResult, file: Path) -> None:
    """Write the holes to drill as CSV: position, angles in degrees, and the shift against the drawing."""
    columns: dict[str, list[str]] = {
        "hole": [drive.hole.name for drive in result.drives],
        "group": [drive.hole.group for drive in result.drives],
    }
    numbers = [[*d.position, *np.degrees(d.angles), *(d.position - d.hole.position)] for d in result.drives]
    names = ("x", "y", "z", "a_deg", "b_deg", "c_deg", "dx", "dy", "dz")
    columns |= {name: [f"{row[i]:.5f}" for row in numbers] for i, name in enumerate(names)}
    write_columns(file, columns)


def drill_document(result: DrillResult) -> dict[str, Any]:
    """Plain numbers for JSON: lengths in length_unit, angles in degrees."""
    measuring, tool_axis = result.T_measuring_base, result.tool_axis
    return {
        "homography": result.H.tolist(),
        "leave_one_out": np.linalg.norm(result.leave_one_out_errors, axis=1).tolist(),
        "groups": {name: _group_document(c) for name, c in result.groups.items()},
        "drives": [_drive_document(d) for d in result.drives],
        "rangers": {
            name: {"origin": r.origin.tolist(), "direction": r.direction.tolist(), "rms": r.rms}
            for name, r in result.rangers.items()
        },
        "T_measuring_base": None if measuring is None else measuring.tolist(),
        "tool_axis": None if tool_axis is None else _tool_axis_document(tool_axis),
        "camera_effects": None if result.effects is None else [vars(trial) for trial in result.effects.trials],
    }


def _group_document(c: GroupCompensation) -> dict[str, Any]:
    return {
        "T_actual_nominal": c.T_actual_nominal.tolist(),
        "drive_errors": np.linalg.norm(c.errors, axis=1).tolist(),
        "residuals": np.linalg.norm(c.residuals, axis=1).tolist(),
    }


def _drive_document(d: Drive) -> dict[str, Any]:
    return {
        "hole": d.hole.name,
        "group": d.hole.group,
        "position": d.position.tolist(),
        "direction": d.direction.tolist(),
        "angles_deg": np.degrees(d.angles).tolist(),
    }


def _tool_axis_document(tool: ToolAxis) -> dict[str, Any]:
    return {
        "axis": tool.axis.tolist(),
        "tilt_deg": float(np.degrees(tool.tilt)),
        "sigma_deg": float(np.degrees(tool.sigma)),
        "p_value": tool.p_value,
        "accepted": tool.accepted,
    }
