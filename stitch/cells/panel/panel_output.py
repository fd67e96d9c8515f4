"""What a panel job found, as a document and as files that a person or a controller can read."""

from pathlib import Path
from typing import Any

import numpy as np

from stitch.cells.panel.global_model import RobotModel
from stitch.cells.panel.legs import LegOffset
from stitch.cells.panel.panel_job import PanelJob
from stitch.cells.panel.panel_solution import PanelResult
from stitch.cells.pose_table import POSE_COLUMNS, rows_from_poses, write_columns, write_poses


def panel_document(job: PanelJob, result: PanelResult) -> dict[str, Any]:
    """Plain data for JSON. mm, degrees, N."""
    out: dict[str, Any] = {
        "robots": {m.name: _robot_document(m) for m in result.models},
        "leg_offsets": {o.robot: _leg_document(o) for o in result.legs},
        "errors": {
            "after_100_mm": result.errors.shift.position[:, -1].max(axis=0).tolist(),
            "after_2_deg": result.errors.turn.position[:, -1].max(axis=0).tolist(),
            "by_master": dict(zip(job.robots, result.errors.by_master.tolist(), strict=True)),
        },
    }
    if result.pose is not None and result.pose_error is not None:
        out["pose"] = {
            "position_error": result.pose_error[3:].tolist(),
            "angle_error_deg": np.degrees(result.pose_error[:3]).tolist(),
            "sigma": np.sqrt(np.diag(result.pose.covariance)[3:]).tolist(),
            "sigma_deg": np.degrees(np.sqrt(np.diag(result.pose.covariance)[:3])).tolist(),
            "targets_rms": float(np.sqrt((result.pose.residuals**2).mean())),
        }
    if result.shape_largest is not None:
        deviation = dict(zip(job.robots, result.shape_largest.tolist(), strict=True))
        ok = bool(result.shape_largest.max() <= job.tolerance)
        out["shape"] = {"largest_deviation": deviation, "tolerance": job.tolerance, "within_tolerance": ok}
    if job.forces is not None:
        out["forces"] = {name: _force_document(row) for name, row in zip(job.robots, job.forces, strict=True)}
    return out


def _leg_document(o: LegOffset) -> dict[str, Any]:
    return {
        "found": o.detected,
        "leg": o.leg,
        "offset": o.offset,
        "sigma": o.sigma,
        "gain": o.chi_square_drop,
        "runner_up": o.runner_up,
        "runner_up_gain": o.runner_up_drop,
    }


def _robot_document(model: RobotModel) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(model.covariance)).reshape(4, 3)
    return {
        "T_world_base": model.T_world_base.tolist(),
        "T_flange_contact": model.T_flange_contact.tolist(),
        "sigma_base": sigma[1].tolist(),
        "sigma_base_deg": np.degrees(sigma[0]).tolist(),
        "sigma_contact": sigma[3].tolist(),
        "sigma_contact_deg": np.degrees(sigma[2]).tolist(),
        "chi_square": model.chi_square,
        "redundancy": model.redundancy,
        "p_value": model.p_value,
    }


def _force_document(row: np.ndarray) -> dict[str, float]:
    return {"force_N": float(np.linalg.norm(row[3:])), "torque_Nm": float(np.linalg.norm(row[:3]) / 1000)}


def write_folder(job: PanelJob, result: PanelResult, folder: Path) -> list[str]:
    """Write commands and model; returns the files' names."""
    folder.mkdir(parents=True, exist_ok=True)
    write_poses(folder / "preposition.csv", "robot", job.robots, result.preposition)
    written = ["preposition.csv", "model.csv"]
    for name, commands in (("pose_move.csv", result.pose_commands), ("shape_move.csv", result.shape_commands)):
        if commands is not None:
            write_poses(folder / name, "robot", job.robots, commands)
            written.append(name)
    if result.shape is not None and job.control is not None:
        off = result.shape.deviations
        columns: dict[str, Any] = {"point": job.control.names, "dx": off[:, 0], "dy": off[:, 1], "dz": off[:, 2]}
        write_columns(folder / "deviations.csv", columns)
        written.append("deviations.csv")
    _write_model(folder / "model.csv", job, result)
    return written


def _write_model(file: Path, job: PanelJob, result: PanelResult) -> None:
    columns: dict[str, Any] = {"robot": list(job.robots)}
    for prefix, name in (("base", "T_world_base"), ("contact", "T_flange_contact")):
        rows = rows_from_poses(np.array([getattr(m, name) for m in result.models]))
        columns |= {f"{prefix}_{k}": rows[:, i] for i, k in enumerate(POSE_COLUMNS.split())}
    sigma = np.array([np.sqrt(np.diag(m.covariance)) for m in result.models])
    for prefix, first in (("base", 0), ("contact", 6)):
        columns[f"{prefix}_sigma_deg"] = np.degrees(sigma[:, first : first + 3].max(axis=1))
        columns[f"{prefix}_sigma_mm"] = sigma[:, first + 3 : first + 6].max(axis=1)
    write_columns(file, columns)
