"""A panel job from its readings to the commands of all robots."""

from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch.cells.panel.errors_along import MotionErrors, errors_along_motion, errors_by_master
from stitch.cells.panel.global_model import RobotModel, calibrate_robot
from stitch.cells.panel.layout import Contacts, clamp_contacts
from stitch.cells.panel.legs import LegOffset, find_leg_offset, true_flanges
from stitch.cells.panel.panel_job import PanelJob
from stitch.cells.panel.panel_motion import adjust_pose, preposition
from stitch.cells.panel.rigid_fit import RigidFit, rigid_fit
from stitch.cells.panel.shape_control import ControlPoints, ShapeStep, largest_deviations, shape_step
from stitch.frames import Array

# The source moves 100 mm and turns 2°.
_DISTANCES = np.linspace(0.0, 100.0, 11)
_ANGLES = np.radians(np.linspace(0.0, 2.0, 11))


@dataclass(frozen=True)
class ExpectedErrors:
    """Of the slaves against the master, from the global model's covariance."""

    shift: MotionErrors
    turn: MotionErrors
    by_master: Array  # (N, 2) worst error of a slave, mm, after the longest shift and turn, if robot N were master


@dataclass(frozen=True)
class PanelResult:
    """Everything a job gives; commands are poses for the controllers, which do not know of leg offsets."""

    contacts: Contacts
    models: tuple[RobotModel, ...]
    legs: tuple[LegOffset, ...]  # empty without the legs' joints
    preposition: Array  # (N, 4, 4)
    errors: ExpectedErrors
    pose: RigidFit | None  # T_world_panel
    pose_error: Array | None  # (6,) twist from target to measured pose, panel frame
    pose_commands: Array | None  # (N, 4, 4)
    shape: ShapeStep | None
    shape_largest: Array | None  # (N,) mm
    shape_commands: Array | None  # (N, 4, 4)


def calibrate_robots(job: PanelJob) -> tuple[tuple[RobotModel, ...], tuple[LegOffset, ...]]:
    """Models of all robots; those in which a leg offset is found are calibrated anew without it.

    Raises:
        NoResultError: a robot has too few poses, or turned about one axis only.
    """
    models, offsets = [], []
    for readings in job.calibration:
        model = calibrate_robot(readings)
        if job.legs is not None:
            offset = find_leg_offset(readings, model, job.legs, 6 * len(job.robots))
            offsets.append(offset)
            if offset.detected:
                real = true_flanges(job.legs, readings.T_base_flange, [(offset.leg, offset.offset)])
                model = calibrate_robot(replace(readings, T_base_flange=real))
        models.append(model)
    return tuple(models), tuple(offsets)


def solve_panel_job(job: PanelJob) -> PanelResult:
    """Model, pre-positions and errors to expect; pose and shape corrections where the job has their readings.

    Raises:
        NoResultError: a step has too few or degenerate readings; names the step.
    """
    models, offsets = calibrate_robots(job)
    bases, clamps = (np.array([getattr(m, name) for m in models]) for name in ("T_world_base", "T_flange_contact"))
    layout = clamp_contacts(job.layout)
    before = preposition(bases, job.T_world_target, layout.T_panel_contact, clamps)
    stand = before if job.flanges is None else _flanges_with_offsets(job, offsets, job.flanges)
    errors = _expected_errors(job, models, stand)
    pose = pose_error = pose_commands = shape = shape_largest = shape_commands = None
    T_world_panel = job.T_world_target
    if job.targets is not None:
        pose = rigid_fit(job.targets.nominal, job.targets.measured, job.tracker.sigma(job.targets.measured))
        T_world_panel, pose_error = pose.T, frames.log(frames.inverse(job.T_world_target) @ pose.T)
        stand = adjust_pose(bases, stand, job.master, pose.T, job.T_world_target)
        pose_commands = _commands_for(job, offsets, stand)
    if job.control is not None:
        # With targets, the shape is evaluated on the panel where it was measured and corrected where it goes.
        seen = frames.transform(frames.inverse(T_world_panel), job.control.measured)
        control = ControlPoints(job.control.nominal, job.control.clamp, layout.T_panel_contact)
        shape = shape_step(seen, control, stand, clamps, axes=job.axes)
        shape_largest = largest_deviations(shape.deviations, control)
        shape_commands = _commands_for(job, offsets, shape.T_base_flange)
    return PanelResult(
        contacts=layout,
        models=models,
        legs=offsets,
        preposition=_commands_for(job, offsets, before),
        errors=errors,
        pose=pose,
        pose_error=pose_error,
        pose_commands=pose_commands,
        shape=shape,
        shape_largest=shape_largest,
        shape_commands=shape_commands,
    )


def _expected_errors(job: PanelJob, models: tuple[RobotModel, ...], stand: Array) -> ExpectedErrors:
    shift = errors_along_motion(models, stand, job.master, _DISTANCES, turn=False)
    turn = errors_along_motion(models, stand, job.master, _ANGLES, turn=True)
    return ExpectedErrors(shift, turn, errors_by_master(models, stand, float(_DISTANCES[-1]), float(_ANGLES[-1])))


def _flanges_with_offsets(job: PanelJob, offsets: tuple[LegOffset, ...], believed: Array, sign: float = 1.0) -> Array:
    """Where the flanges (N, 4, 4) really are when the controllers believe them at `believed`."""
    real = believed.copy()
    for i, offset in enumerate(offsets):
        if offset.detected and job.legs is not None:
            real[i] = true_flanges(job.legs, believed[i : i + 1], [(offset.leg, sign * offset.offset)])[0]
    return real


def _commands_for(job: PanelJob, offsets: tuple[LegOffset, ...], target_flanges: Array) -> Array:
    """What to tell the controllers so that the flanges really come to `target_flanges`; first order in the offset."""
    return _flanges_with_offsets(job, offsets, target_flanges, sign=-1.0)
