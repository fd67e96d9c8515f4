"""A drilling job from its readings to the corrected drives."""

from dataclasses import dataclass

import numpy as np

from stitch.cells.drilling.base_frame import base_frame
from stitch.cells.drilling.camera_effects import EffectSelection, select_effects
from stitch.cells.drilling.compensation import GroupCompensation, compensate_group
from stitch.cells.drilling.drill_job import DrillJob, Hole
from stitch.cells.drilling.hole_frame import euler_zyx, hole_rotation
from stitch.cells.drilling.homography import fit_homography, leave_one_out, to_plane
from stitch.cells.drilling.rangers import RangerFit, fit_ranger
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
class DrillResult:
    """Everything a job gives. Lengths in length_unit."""

    H: Array  # (3, 3) work plane to image
    leave_one_out_errors: Array  # (N, 2) of the plate's holes, in the work plane
    groups: dict[str, GroupCompensation]
    drives: tuple[Drive, ...]
    rangers: dict[str, RangerFit]
    T_measuring_base: Array | None
    effects: EffectSelection | None  # of the camera; None without check holes
    tool_axis: ToolAxis | None


def solve_drill_job(job: DrillJob) -> DrillResult:
    """Homography, compensation of every group, and what else the job holds readings for.

    What the check holes show of the camera is taken out of the reference holes' places.

    Raises:
        NoResultError: a step has too few or degenerate readings; names the step.
    """
    xy = job.plate_xyz[:, :2]
    H = fit_homography(xy, job.plate_uv)
    effects = select_effects(job.checks) if job.checks is not None else None
    groups: dict[str, GroupCompensation] = {}
    for group in dict.fromkeys(hole.group for hole in job.holes):
        references = [hole for hole in job.holes if hole.group == group and hole.reference]
        if len(references) < 3:
            raise NoResultError(f"group {group}: {len(references)} reference holes; a group needs three or more")
        actual = np.array([_measured_hole(job, H, effects, hole.name) for hole in references])
        groups[group] = compensate_group(np.array([hole.position for hole in references]), actual)
    tool_axis = _fitted_tool_axis(job, groups)
    return DrillResult(
        H,
        leave_one_out_errors=leave_one_out(xy, job.plate_uv) if len(xy) > 4 else np.empty((0, 2)),
        groups=groups,
        drives=tuple(_corrected_drive(hole, groups[hole.group], tool_axis) for hole in job.holes if not hole.reference),
        rangers={name: fit_ranger(*readings) for name, readings in job.rangers.items()},
        T_measuring_base=base_frame(*job.marker_paths) if job.marker_paths else None,
        effects=effects,
        tool_axis=tool_axis,
    )


def _fitted_tool_axis(job: DrillJob, groups: dict[str, GroupCompensation]) -> ToolAxis | None:
    """From each reference hole once, whatever number of groups it serves."""
    references = {hole.name: hole for hole in job.holes if hole.reference}
    directions = [groups[h.group].T_actual_nominal[:3, :3] @ h.direction for h in references.values()]
    return find_tool_axis(np.array([job.placed[name].T_base_tool[:3, :3] for name in references]), np.array(directions))


def _corrected_drive(hole: Hole, group: GroupCompensation, tool_axis: ToolAxis | None) -> Drive:
    position, direction = (found[0] for found in group.apply(hole.position[None], hole.direction[None]))
    R = hole_rotation(direction)
    return Drive(hole, position, direction, R if tool_axis is None else tool_axis.orient(R))


def _measured_hole(job: DrillJob, H: Array, effects: EffectSelection | None, name: str) -> Array:
    """Drive coordinate (3,) of a reference hole from where the robot ended and what it saw there."""
    placed = job.placed[name]
    offset = np.append(hole_in_plane(job, H, effects, name), placed.height - job.height)
    return hole_coordinate(placed.T_base_tool, offset)


def hole_in_plane(job: DrillJob, H: Array, effects: EffectSelection | None, name: str) -> Array:
    """x, y (2,) in the flange frame at which the camera saw a reference hole.

    Where check holes have shown the camera beyond its work plane, at the hole's own height and without the effects that
    were selected; else as if the hole lay in the work plane: a camera tilted by 25° is then off by 0.47 mm for each mm.
    """
    placed = job.placed[name]
    if effects is not None:
        return np.asarray(effects.camera.plane(placed.uv[None], placed.height)[0])
    return np.asarray(to_plane(H, placed.uv[None])[0])
