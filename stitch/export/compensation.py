"""Commanded joint angles with which the true arm goes where a program meant it to go."""

from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch.export.arm_model import ArmModel
from stitch.export.inverse_kinematics import LEVER
from stitch.frames import Array
from stitch.measurement import robot as kinematics
from stitch.model.hand_eye_uncertainty import COVERAGE_FACTOR
from stitch.model.term import Term, values_of, with_parameter_values

_COMPENSATION_STEPS = 30
_STEP_TOLERANCE = 1e-13
# Motions that a unit of joint angles turns into less than this part of the largest are not asked of the arm: at a
# singular pose whole turns would bring micrometres.
_SINGULAR = 1e-3


@dataclass(frozen=True)
class ProgramCompensation:
    """K targets, commanded anew; lengths in length_unit, angles in rad."""

    joints: Array  # (K, n) commanded
    move: Array  # (K, 4, 4) of the tool, T_meant_commanded of the nominal arm: what a Cartesian target moves by
    residual: Array  # (K, 6) twist of the tool by which the true arm still misses the meant pose under the model
    U: Array  # (K,) expanded uncertainty (k = 2) of the tool's position, parameters as independent


def compensate_targets(arm: ArmModel, joints: Array, T_flange_tool: Array) -> ProgramCompensation:
    """Solve true_flange(commanded) = forward(nominal) for targets one after the other.

    Newton steps with the nominal arm's Jacobian: the true one differs from it by thousandths, and so does the error
    after each step.

    Args:
        joints: (K, n) rad that the nominal arm would take.
        T_flange_tool: (4, 4) of the place that matters, length_unit.
    """
    meant = kinematics.forward(arm.robot, joints)
    approach = _approach_directions(joints)
    weight = np.repeat([1.0, arm.robot.metres_per_unit / LEVER], 3)
    q = joints.copy()

    def missed(q: Array) -> Array:
        return frames.log(frames.inverse(arm.true_flange(q, _previous_joints(q), approach)) @ meant)

    for _ in range(_COMPENSATION_STEPS):
        J = weight[:, None] * kinematics.jacobian(arm.robot, q)
        inverse = np.linalg.pinv(J, rcond=_SINGULAR)
        step = np.einsum("kij,kj->ki", inverse, weight * missed(q))
        q = q + step
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    q = np.where(np.abs(q - joints) < _STEP_TOLERANCE, joints, q)
    T_tool_flange = frames.inverse(T_flange_tool)
    move = T_tool_flange @ frames.inverse(meant) @ kinematics.forward(arm.robot, q) @ T_flange_tool
    left = missed(q) @ frames.adjoint(T_tool_flange).T
    return ProgramCompensation(q, move, left, _uncertainty(arm, q, approach, T_flange_tool))


def _previous_joints(q: Array) -> Array:
    """(K, n) of the targets before; its own for the first."""
    return np.vstack([q[:1], q[:-1]])


def _approach_directions(q: Array) -> Array:
    """(K, n) how the joints come from the targets before: 0 where nobody knows or nothing moves."""
    move = q - _previous_joints(q)
    return np.where(np.abs(move) > 1e-9, np.sign(move), 0.0)


def _uncertainty(arm: ArmModel, q: Array, approach: Array, T_flange_tool: Array) -> Array:
    """(K,) 2·√tr(J·Σ·Jᵀ), Σ of all fitted parameters together: errors of one make up for errors of another."""

    def place(terms: tuple[Term, ...]) -> Array:
        return np.asarray(
            (replace(arm, terms=terms).true_flange(q, _previous_joints(q), approach) @ T_flange_tool)[:, :3, 3]
        )

    here, values = place(arm.terms), values_of(arm.terms)
    # Columns of the root are steps of about one sigma: J·L by differences, column by column.
    steps = arm.covariance.root(arm.terms).T
    moved = np.array([place(with_parameter_values(arm.terms, values + step)) - here for step in steps]).reshape(
        -1, *here.shape
    )
    return np.asarray(COVERAGE_FACTOR * np.sqrt(np.einsum("pki,pki->k", moved, moved)))
