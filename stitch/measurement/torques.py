"""Torques that bend the joints of an arm at its views: measured, or of gravity with masses or without."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array
from stitch.measurement import robot as kinematics
from stitch.measurement.robot import Robot
from stitch.measurement.session import Session

PAYLOAD = "payload_kg"  # column: what the flange carries, at the centre of mass of [robot] payload, else at the flange
# Joint angles that show which torques of an arm differ.
_ANYWHERE = 100
STILL = 1e-3  # N·m of 1 kg: an axis that gravity does not bend


@dataclass(frozen=True)
class Torques:
    """Torques under which joints sag: with masses one a joint, without them one a joint and a link beyond."""

    names: tuple[str, ...]
    joint: tuple[int, ...]  # that the torque bends
    values: Array  # (V, m) N·m about +z of that joint; of 1 kg at the link's frame where masses are unknown
    measured: bool = False


def torques_of(robot: Robot, joints: Array, payload: Array | None = None) -> Torques:
    """Gravity torques at joint angles (V, n); which ones there are is the arm's own, whatever the angles.

    Args:
        payload: (V,) kg, in place of the mass in [robot] payload.
    """
    if payload is None and robot.has_masses:
        return _each_joint(kinematics.gravity_torques(robot, joints))
    if payload is None and not robot.payload_mass:
        return _unit_link_torques(robot, joints)
    payload = np.full(len(joints), robot.payload_mass) if payload is None else payload
    carried = payload[:, None] * kinematics.payload_torques(robot, joints)
    if robot.has_masses:
        return _each_joint(kinematics.gravity_torques(replace(robot, payload_mass=0.0), joints) + carried)
    # What the links weigh nobody knows, what they carry is known: a coefficient of its own for every joint it bends.
    links = _unit_link_torques(robot, joints)
    bent = np.flatnonzero(np.ptp(kinematics.payload_torques(robot, _sample_joints(robot)), axis=0) > STILL)
    names = (*links.names, *(str(i + 1) for i in bent))
    return Torques(names, (*links.joint, *(int(i) for i in bent)), np.hstack([links.values, carried[:, bent]]))


def measured_torques(drives: Array) -> Torques:
    """Of drives (V, n), N·m, as controllers report them: a drive holds the opposite of what bends its joint."""
    return replace(_each_joint(-drives), measured=True)


def torque_columns(covariates: Mapping[str, Array], joints: int) -> Array | None:
    """(V, n) the columns jN_torque_nm of all joints, or None where one is missing."""
    names = [f"j{i + 1}_torque_nm" for i in range(joints)]
    whole = bool(names) and all(name in covariates for name in names)
    return np.column_stack([covariates[name] for name in names]) if whole else None


def payload_note(session: Session) -> str:
    """Where a payload counts whose centre of mass nobody states; empty where one is stated, or nothing is carried."""
    robot = session.robot
    if robot is None or not robot.carries_at_flange or any(view.joints is None for view in session.views):
        return ""
    columns = [view.covariates for view in session.views]
    if all("j1_torque_nm" in column for column in columns):
        return ""  # drives report what bends the joints
    loads = [column.get(PAYLOAD, robot.payload_mass) for column in columns]
    if not any(loads):
        return ""
    return (
        f"The payload, up to {max(loads):g} kg, counts at the flange's origin: [robot] payload states no other centre "
        "of mass (com)."
    )


def _each_joint(values: Array) -> Torques:
    n = values.shape[1]
    return Torques(tuple(str(i + 1) for i in range(n)), tuple(range(n)), values)


def _sample_joints(robot: Robot) -> Array:
    """(N, n) joint angles from everywhere: a coefficient must mean the same in every session of an arm."""
    return np.random.default_rng(0).uniform(-np.pi, np.pi, (_ANYWHERE, robot.n_joints))


def _unit_link_torques(robot: Robot, joints: Array) -> Torques:
    """Of 1 kg at each link's frame, as far as they differ: without masses the geometry gives their shapes alone."""
    n = robot.n_joints
    shapes = kinematics.unit_torques(robot, _sample_joints(robot))
    keep = [(i, k) for i in range(n) for k in _independent_links(shapes[:, i], range(i, n))]
    unit = kinematics.unit_torques(robot, joints)
    values = np.array([unit[:, i, k] for i, k in keep]).T.reshape(len(joints), len(keep))
    return Torques(tuple(f"{i + 1}_{k + 1}" for i, k in keep), tuple(i for i, _ in keep), values)


def _independent_links(torques: Array, links: Sequence[int]) -> list[int]:
    """The links whose unit torque (V, n) about one joint changes and is no combination of those before it.

    Frames of a wrist share their origin: a second torque from the same place would only make both unknown.
    """
    chosen, basis = list[int](), np.zeros((len(torques), 0))
    for k in links:
        own = torques[:, k]
        rest = own - basis @ (basis.T @ own)
        if np.ptp(own) > STILL and np.linalg.norm(rest) > 1e-6 * np.linalg.norm(own):
            chosen.append(k)
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
    return chosen
