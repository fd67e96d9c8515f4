"""Gravity torques of an arm at the joints of its views, with masses or without."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.measurement import robot as kinematics
from stitch.measurement.robot import Robot

# Joint angles that show which torques of an arm differ.
_ANYWHERE = 100


@dataclass(frozen=True)
class Torques:
    """Gravity torques of which joints sag: with masses one a joint, without them one a joint and a link beyond."""

    names: tuple[str, ...]
    joint: tuple[int, ...]  # that the torque bends
    values: Array  # (V, m) N·m about +z of that joint; of 1 kg at the link's frame where masses are unknown


def torques_of(robot: Robot, joints: Array) -> Torques:
    """Gravity torques at joint angles (V, n); which ones there are is the arm's own, whatever the angles."""
    n = robot.n_joints
    if robot.has_masses:
        values = kinematics.gravity_torques(robot, joints)
        return Torques(tuple(str(i + 1) for i in range(n)), tuple(range(n)), values)
    # Without masses the shape of every torque follows from the geometry: 1 kg at each link's frame. Angles from
    # everywhere choose among them: a coefficient must mean the same in every session of an arm.
    everywhere = np.random.default_rng(0).uniform(-np.pi, np.pi, (_ANYWHERE, n))
    shapes = kinematics.unit_torques(robot, everywhere)
    keep = [(i, k) for i in range(n) for k in _different(shapes[:, i], range(i, n))]
    unit = kinematics.unit_torques(robot, joints)
    values = np.array([unit[:, i, k] for i, k in keep]).T.reshape(len(joints), len(keep))
    return Torques(tuple(f"{i + 1}_{k + 1}" for i, k in keep), tuple(i for i, _ in keep), values)


def _different(torques: Array, links: Sequence[int]) -> list[int]:
    """The links whose unit torque (V, n) about one joint changes and is no combination of those before it.

    Frames of a wrist share their origin: a second torque from the same place would only make both unknown.
    """
    chosen, basis = list[int](), np.zeros((len(torques), 0))
    for k in links:
        own = torques[:, k]
        rest = own - basis @ (basis.T @ own)
        if np.ptp(own) > 1e-3 and np.linalg.norm(rest) > 1e-6 * np.linalg.norm(own):
            chosen.append(k)
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
    return chosen
