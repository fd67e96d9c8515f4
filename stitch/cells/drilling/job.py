"""A drilling job from its readings to the corrected drives."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stitch.cells.drilling.base_frame import base_frame
from stitch.cells.drilling.compensation import Compensation, compensate
from stitch.cells.drilling.hidden_effects import Naming, name_effects
from stitch.cells.drilling.hole_frame import euler_zyx, hole_rotation
from stitch.cells.drilling.homography import fit_homography, leave_one_out, to_plane
from stitch.cells.drilling.rangers import RangerFit, fit_ranger
from stitch.cells.drilling.reading import Hole, Job
from stitch.cells.drilling.servo import hole_coordinate
from stitch.cells.drilling.tool_axis import ToolAxis, find_tool_axis
from stitch.errors import NoResultError
from stitch.frames import Array


@dataclass(frozen=True)
class Drive:
    """Where the robot is sent to drill one hole."""

    hole: Hole
    position: Array  # (3,)
    direction: Array  # (3,) of the hole
    rotation: Array  # (3, 3) reported orientation of the tool

    @property
    def angles(self) -> Array:
        """(3,) in rad about z, y', x''."""
        return euler_zyx(self.rotation)


@dataclass(frozen=True)
class JobResult:
    """Everything a job gives. Lengths in length_unit."""

    H: Array  # (3, 3) work plane to image
    left_out: Array  # (N, 2) leave-one-out errors of the plate's holes
    groups: dict[str, Compensation]
    drives: tuple[Drive, ...]
    rangers: dict[str, RangerFit]
    T_measuring_base: Array | None
    naming: Naming | None
    tool_axis: ToolAxis | None


def solve_job(job: Job) -> JobResult:
    """Homography, compensation of every group, and what else the job holds readings for.

    What the check holes show of the camera is taken out of the reference holes' places.

    Raises:
        NoResultError: a step has too few or degenerate readings; names the step.
    """
    xy = job.plate_xyz[:, :2]
    H = fit_homography(xy, job.plate_uv)
    naming = name_effects(job.checks) if job.checks is not None else None
    groups: dict[str, Compensation] = {}
    for group in dict.fromkeys(hole.group for hole in job.holes):
        references = [hole for hole in job.holes if hole.group == group and hole.reference]
        if len(references) < 3:
            raise NoResultError(f"group {group}: {len(references)} reference holes; a group needs three or more")
        actual = np.array([_actual(job, H, naming, hole.name) for hole in references])
        groups[group] = compensate(np.array([hole.position for hole in references]), actual)
    tool_axis = _tool_axis(job, groups)
    return JobResult(
        H, leave_one_out(xy, job.plate_uv) if len(xy) > 4 else np.empty((0, 2)), groups,
        tuple(_drive(hole, groups[hole.group], tool_axis) for hole in job.holes if not hole.reference),
        {name: fit_ranger(*readings) for name, readings in job.rangers.items()},
        base_frame(*job.marker_paths) if job.marker_paths else None, naming, tool_axis,
    )  # fmt: skip


def _tool_axis(job: Job, groups: dict[str, Compensation]) -> ToolAxis | None:
    """From each reference hole once, whatever number of groups it serves."""
    references = {hole.name: hole for hole in job.holes if hole.reference}
    directions = [groups[h.group].T_actual_nominal[:3, :3] @ h.direction for h in references.values()]
    return find_tool_axis(np.array([job.placed[name][0][:3, :3] for name in references]), np.array(directions))


def _drive(hole: Hole, group: Compensation, tool_axis: ToolAxis | None) -> Drive:
    position, direction = (found[0] for found in group.apply(hole.position[None], hole.direction[None]))
    R = hole_rotation(direction)
    return Drive(hole, position, direction, R if tool_axis is None else tool_axis.orient(R))


def _actual(job: Job, H: Array, naming: Naming | None, name: str) -> Array:
    """Drive coordinate (3,) of a reference hole from where the robot ended and what it saw there."""
    T_base_tool, _, height = job.placed[name]
    return hole_coordinate(T_base_tool, np.append(seen_in_plane(job, H, naming, name), height - job.height))


def seen_in_plane(job: Job, H: Array, naming: Naming | None, name: str) -> Array:
    """x, y (2,) in the flange frame at which the camera saw a reference hole.

    Where check holes have shown the camera beyond its work plane, at the hole's own height and without the effects that
    were named; else as if the hole lay in the work plane: a camera tilted by 25° is then off by 0.47 mm for each mm.
    """
    _, uv, height = job.placed[name]
    if naming is not None:
        return np.asarray(naming.camera.plane(uv[None], height)[0])
    return np.asarray(to_plane(H, uv[None])[0])


def write_drives(result: JobResult, file: Path) -> None:
    """The holes to drill as CSV: position, angles in degrees, and the shift against the drawing."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["hole", "group", "x", "y", "z", "a_deg", "b_deg", "c_deg", "dx", "dy", "dz"])
        for drive in result.drives:
            numbers = [*drive.position, *np.degrees(drive.angles), *(drive.position - drive.hole.position)]
            writer.writerow([drive.hole.name, drive.hole.group, *(f"{value:.5f}" for value in numbers)])


def document(result: JobResult) -> dict[str, Any]:
    """Plain numbers for JSON: lengths in length_unit, angles in degrees."""
    naming = result.naming
    return {
        "homography": result.H.tolist(),
        "leave_one_out": np.linalg.norm(result.left_out, axis=1).tolist(),
        "groups": {
            name: {
                "T_actual_nominal": c.T_actual_nominal.tolist(),
                "drive_errors": np.linalg.norm(c.errors, axis=1).tolist(),
                "residuals": np.linalg.norm(c.residuals, axis=1).tolist(),
            }
            for name, c in result.groups.items()
        },
        "drives": [
            {"hole": d.hole.name, "group": d.hole.group, "position": d.position.tolist(),
             "direction": d.direction.tolist(), "angles_deg": np.degrees(d.angles).tolist()}
            for d in result.drives
        ],
        "rangers": {
            name: {"origin": r.origin.tolist(), "direction": r.direction.tolist(), "rms": r.rms}
            for name, r in result.rangers.items()
        },
        "T_measuring_base": None if result.T_measuring_base is None else result.T_measuring_base.tolist(),
        "tool_axis": None if result.tool_axis is None else {
            "axis": result.tool_axis.axis.tolist(), "tilt_deg": float(np.degrees(result.tool_axis.tilt)),
            "sigma_deg": float(np.degrees(result.tool_axis.sigma)), "p_value": result.tool_axis.p_value,
            "accepted": result.tool_axis.accepted,
        },
        "camera_effects": None if naming is None else [vars(trial) for trial in naming.trials],
    }  # fmt: skip
