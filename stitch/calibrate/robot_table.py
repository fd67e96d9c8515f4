"""An arm as the [robot] table of session.toml."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import tomli_w

from stitch.measurement.robot import Robot
from stitch.measurement.session import StatedRepeatability


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


def robot_toml(robot: Robot, comments: Sequence[str] = (), stated: StatedRepeatability | None = None) -> str | None:
    """The [robot] table of session.toml below lines of comment; None for an arm that came as URDF.

    Args:
        stated: repeatability that the nominal table has; a table that takes its place says the same.
    """
    rows = dh_rows(robot)
    if rows is None:
        return None
    table: dict[str, Any] = {
        "name": robot.name,
        "dh": robot.convention,
        "gravity": robot.gravity.tolist(),
        "joints": rows,
    }
    # Without a mass the centre is that of the column payload_kg.
    if robot.payload_mass or not robot.carries_at_flange:
        table["payload"] = {"mass": robot.payload_mass, "com": robot.payload_com.tolist()}
    if stated is not None and (repeatability := repeatability_table(stated)):
        table["repeatability"] = repeatability
    return "".join(f"# {line}\n" for line in comments) + tomli_w.dumps({"robot": table})


def repeatability_table(stated: StatedRepeatability) -> dict[str, float]:
    """Return [robot] repeatability as session.toml writes it: length_unit, mrad; {} where nothing is stated."""
    turn = None if stated.rotation is None else 1e3 * stated.rotation
    return {key: x for key, x in (("position", stated.position), ("rotation_mrad", turn)) if x is not None}
