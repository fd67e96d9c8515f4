"""An arm as the [robot] table of session.toml."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import tomli_w

from stitch.measurement.robot import Robot


def dh_rows(robot: Robot) -> list[dict[str, Any]] | None:
    """Rows of [robot] joints in session.toml, angles in degrees; None for an arm that came as URDF."""
    if robot.a is None or robot.alpha is None or robot.d is None:
        return None
    rows = []
    for i in range(robot.n_joints):
        row: dict[str, Any] = {
            "a": float(robot.a[i]),
            "alpha_deg": float(np.degrees(robot.alpha[i])),
            "d": float(robot.d[i]),
            "theta_deg": float(np.degrees(robot.theta[i])),
        }
        if robot.mass[i]:
            row |= {"mass": float(robot.mass[i]), "com": robot.com[i].tolist()}
        rows.append(row)
    return rows


def robot_toml(robot: Robot, told: Sequence[str] = ()) -> str | None:
    """The [robot] table of session.toml below lines of comment; None for an arm that came as URDF."""
    rows = dh_rows(robot)
    if rows is None:
        return None
    table: dict[str, Any] = {
        "name": robot.name,
        "dh": robot.convention,
        "gravity": robot.gravity.tolist(),
        "joints": rows,
    }
    if robot.payload_mass:
        table["payload"] = {"mass": robot.payload_mass, "com": robot.payload_com.tolist()}
    return "".join(f"# {line}\n" for line in told) + tomli_w.dumps({"robot": table})
