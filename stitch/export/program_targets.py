"""The targets of a program as joint angles of the session's arm."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.controllers.program import Program
from stitch.controllers.taught import TaughtPoint
from stitch.errors import InputError
from stitch.export.arm_model import ArmModel
from stitch.export.inverse_kinematics import joint_solutions
from stitch.frames import Array
from stitch.measurement import robot as kinematics

# From the target before, an arm goes on in the same configuration while no joint turns by more than this (rad).
_SAME = np.radians(90.0)
# Poses of the run from which a first target is looked for.
_STARTS = 40
# Joints and pose of one waypoint agree within the calibration of an arm and the rounding of both (m).
_AGREE = 0.02


@dataclass(frozen=True)
class ProgramTargets:
    """K targets of a program. Lengths in the session's length_unit."""

    joints: Array  # (K, n) rad, of the session's arm
    T_flange_tool: Array  # (4, 4)
    cartesian: tuple[bool, ...]  # the joint angles are those of the inverse kinematics


def couple_j2_j3(joints: Array, sign: float = 1.0) -> Array:
    """FANUC's J3 counts from the horizontal: the third joint of DH rows is J2 + J3 (sign −1 for the way back)."""
    out = np.array(joints, float)
    out[..., 2] += sign * out[..., 1]
    return out


def program_targets(
    program: Program, arm: ArmModel, near: Array | None = None, j2_in_j3: bool = False
) -> ProgramTargets:
    """Joint angles that the nominal arm takes at each target.

    Those of a pose are found from the target before, the first from `near` or from the poses of the run: that arm
    configuration is taken which needs the least turn.

    Args:
        near: (n,) rad about which the arm works.
        j2_in_j3: the program's J3 is a FANUC's, the session's third joint is J2 + J3.

    Raises:
        InputError: joints of another arm, a pose out of reach, a waypoint whose joints and pose contradict each other.
    """
    unit = 1e-3 / arm.robot.metres_per_unit
    T_base_frame, T_flange_tool = (_scaled_pose(T, unit) for T in (program.T_base_frame, program.T_flange_tool))
    starts = arm.joints[:: max(1, len(arm.joints) // _STARTS)] if near is None else near[None]
    found: list[Array] = []
    for point in program.points:
        if point.T_frame_tool is None:
            assert point.joints is not None
            found.append(_taught_joints(program, arm, point, j2_in_j3))
            continue
        T = T_base_frame @ _scaled_pose(point.T_frame_tool, unit) @ frames.inverse(T_flange_tool)
        if point.joints is not None:
            found.append(_taught_joints(program, arm, point, j2_in_j3))
            _require_agreement(program, arm, point, kinematics.forward(arm.robot, found[-1]), T)
        else:
            found.append(_nearest_solution(program, arm, point, T, found[-1] if found else None, starts))
    cartesian = tuple(point.joints is None for point in program.points)
    return ProgramTargets(np.array(found), T_flange_tool, cartesian)


def _scaled_pose(T: Array, unit: float) -> Array:
    out = T.copy()
    out[:3, 3] *= unit
    return out


def _taught_joints(program: Program, arm: ArmModel, point: TaughtPoint, j2_in_j3: bool) -> Array:
    assert point.joints is not None
    n = arm.robot.n_joints
    if len(point.joints) != n:
        raise InputError(
            f"{program.file} line {point.line}: {point.name} has {len(point.joints)} joints, the arm of session "
            f"{arm.session} has {n}; to fix: name a program of that arm"
        )
    return couple_j2_j3(point.joints) if j2_in_j3 else point.joints


def _nearest_solution(
    program: Program, arm: ArmModel, point: TaughtPoint, T: Array, before: Array | None, starts: Array
) -> Array:
    """The solution nearest to the target before, or to the poses of the run."""
    if before is not None:
        onward = joint_solutions(arm.robot, T, before[None])
        if len(onward) and np.abs(onward[0] - before).max() < _SAME:
            return np.asarray(onward[0])
    found = joint_solutions(arm.robot, T, starts if before is None else np.vstack([before[None], starts]))
    if not len(found):
        raise InputError(
            f"{program.file} line {point.line}: {point.name} is out of reach of the arm of session {arm.session}; to "
            "fix: check --frame and --tool, or state joint angles nearby with --near"
        )
    reference = starts if before is None else before[None]
    turn = np.linalg.norm(found[:, None] - reference, axis=2).min(axis=1)
    return np.asarray(found[turn.argmin()])


def _require_agreement(program: Program, arm: ArmModel, point: TaughtPoint, T_joints: Array, T_pose: Array) -> None:
    off = float(np.linalg.norm(T_joints[:3, 3] - T_pose[:3, 3])) * arm.robot.metres_per_unit
    if off > _AGREE:
        raise InputError(
            f"{program.file} line {point.line}: joints and pose of {point.name} are {off * 1e3:.0f} mm apart; to fix: "
            "check --tool, --frame, and that the session's [robot] is this arm"
        )
