"""Torques that bend the joints of an arm at its views, as drives report them, else those of gravity; and the moments of
arm and load that tilt its base."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from stitch.numerics.frames import Array
from stitch.session import robot as kinematics
from stitch.session.robot import Robot
from stitch.system.values import take_rows

PAYLOAD = "payload_kg"  # column: what the flange carries, at the centre of mass of [robot] payload, else at the flange
# So many joint angles show which torques of an arm differ.
_SAMPLES = 100
STILL = 1e-3  # N·m of 1 kg: an axis that gravity does not bend


@dataclass(frozen=True)
class Torques:
    """The m torques under which joints sag, in V views.

    With known masses one for each joint; else one for each pair of a joint and a link that it carries, of 1 kg.
    """

    names: tuple[str, ...]  # "2" of joint 2; "2_4" of joint 2 by link 4
    joint: tuple[int, ...]  # that the torque bends
    values: Array  # (V, m) N·m about +z of that joint; of 1 kg at the link's frame where masses are unknown
    measured: bool = False  # reported by the drives
    # Moments about the base's axes x and y: of arm and load where masses are known, else of 1 kg at each link's frame.
    base_names: tuple[str, ...] = ()  # _x, _y; without masses _x_3 of link 3, and _x, _y of a load that is known
    base_axis: tuple[int, ...] = ()  # 0 for x, 1 for y
    base: Array = field(default_factory=partial(np.zeros, (0, 0)))  # (V, k) N·m

    def only(self, keep: Sequence[int]) -> "Torques":
        """Return the torques and moments of some of the views, by index."""
        return take_rows(self, keep, *(["values", "base"] if self.base_names else ["values"]))

    def followed_by(self, later: "Torques") -> "Torques":
        """Return the torques and moments of these views followed by those of later ones of the same arm."""
        base = np.concatenate([self.base, later.base]) if self.base_names else self.base
        return replace(self, values=np.concatenate([self.values, later.values]), base=base)


def torques_of(robot: Robot, joints: Array, payload: Array | None = None) -> Torques:
    """Return the torques of gravity, N·m, at joint angles (V, n) rad.

    Links of known mass: the sum over links and payload for each joint. Unknown masses: one torque of 1 kg for each
    joint and link; of a known payload also one for each joint that it bends. Which are listed depends on the arm alone,
    not on the angles.

    Args:
        payload: (V,) kg, in place of the mass in [robot] payload.
    """
    of_base = _base_moments(robot, joints, payload)
    if payload is None and robot.has_masses:
        return replace(_each_joint(kinematics.gravity_torques(robot, joints)), **of_base)
    if payload is None and not robot.payload_mass:
        return replace(_unit_link_torques(robot, joints), **of_base)
    payload = np.full(len(joints), robot.payload_mass) if payload is None else payload
    carried = payload[:, None] * kinematics.payload_torques(robot, joints)
    if robot.has_masses:
        arm_alone = kinematics.gravity_torques(replace(robot, payload_mass=0.0), joints)
        return replace(_each_joint(arm_alone + carried), **of_base)
    # The links' masses are unknown, the payload's is not: its torque has a compliance of its own at each joint.
    links = _unit_link_torques(robot, joints)
    shapes = kinematics.payload_torques(robot, _sample_joints(robot))
    bent = np.flatnonzero(np.ptp(shapes, axis=0) > STILL).tolist()
    names = (*links.names, *(str(i + 1) for i in bent))
    values = np.hstack([links.values, carried[:, bent]])
    return Torques(names, (*links.joint, *bent), values, **of_base)


def _base_moments(robot: Robot, joints: Array, payload: Array | None) -> dict[str, Any]:
    """Return the fields base_names, base_axis and base of `Torques`: moments about the base's x and y that tilt it.

    Args:
        payload: (V,) kg; None: the mass in [robot] payload.
    """
    per_kg = kinematics.base_moments(robot, joints)[..., :2]  # (V, n + 1, 2) of 1 kg at each link, the payload's last
    load = np.full(len(joints), robot.payload_mass) if payload is None else payload
    moments = load[:, None] * per_kg[:, -1]
    columns = list[tuple[str, int, Array]]()  # name, axis and moments (V,) of each
    if robot.has_masses:
        moments = moments + np.einsum("k,vki->vi", robot.mass, per_kg[:, :-1])
    else:
        shapes = kinematics.base_moments(robot, _sample_joints(robot))[:, :-1]
        links = [(i, k) for i in range(2) for k in _independent_links(shapes[..., i], range(robot.n_joints))]
        columns = [(f"_{'xy'[i]}_{k + 1}", i, per_kg[:, k, i]) for i, k in links]
    if robot.has_masses or load.any():
        columns += [(f"_{'xy'[i]}", i, moments[:, i]) for i in range(2)]
    values = np.array([value for *_, value in columns]).T.reshape(len(joints), len(columns))
    return {"base_names": tuple(c[0] for c in columns), "base_axis": tuple(c[1] for c in columns), "base": values}


def _each_joint(values: Array) -> Torques:
    """Return torques (V, n) N·m, one for each joint, by the joint's number from 1."""
    joints = range(values.shape[1])
    return Torques(tuple(str(i + 1) for i in joints), tuple(joints), values)


def _unit_link_torques(robot: Robot, joints: Array) -> Torques:
    """Return the torques, N·m, about joint i of 1 kg at the frame of link k, named "i_k", at joint angles (V, n) rad.

    Without masses a torque is known but for a factor. Only pairs count whose torque is not a combination of those of
    other links about the same joint.
    """
    n = robot.n_joints
    shapes = kinematics.unit_torques(robot, _sample_joints(robot))
    keep = [(i, k) for i in range(n) for k in _independent_links(shapes[:, i], range(i, n))]
    unit = kinematics.unit_torques(robot, joints)
    values = np.array([unit[:, i, k] for i, k in keep]).T.reshape(len(joints), len(keep))
    return Torques(tuple(f"{i + 1}_{k + 1}" for i, k in keep), tuple(i for i, _ in keep), values)


def _independent_links(torques: Array, links: Sequence[int]) -> list[int]:
    """Return the links whose torque about one joint varies and is no linear combination of those chosen before.

    Frames of a wrist share their origin: factors of two torques from the same place could not be told apart.

    Args:
        torques: (V, n) N·m of 1 kg at each link, about one joint.
        links: indices to choose from, in this order.
    """
    chosen = list[int]()
    basis = np.zeros((len(torques), 0))
    for k in links:
        torque = torques[:, k]
        rest = torque - basis @ (basis.T @ torque)
        if np.ptp(torque) > STILL and np.linalg.norm(rest) > 1e-6 * np.linalg.norm(torque):
            chosen.append(k)
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
    return chosen


def _sample_joints(robot: Robot) -> Array:
    """Return fixed random joint angles (N, n), rad: which torques differ is then the same in all sessions of an arm."""
    return np.random.default_rng(0).uniform(-np.pi, np.pi, (_SAMPLES, robot.n_joints))


def torques_of_views(robot: Robot, joints: Array, covariates: Mapping[str, Array]) -> Torques:
    """Return the torques that bend the joints at angles (V, n) rad: as the drives report them, else those of gravity.

    Args:
        covariates: column of views.csv -> (V,). jN_torque_nm, if all joints have it, is reported by the drives;
            payload_kg is the mass that the flange carries.
    """
    drives = [name for name in torque_columns(joints.shape[1]) if name in covariates]
    if not drives or len(drives) < joints.shape[1]:
        return torques_of(robot, joints, covariates.get(PAYLOAD))
    # A drive holds the opposite of what bends its joint.
    held = _each_joint(-np.column_stack([covariates[name] for name in drives]))
    return replace(held, measured=True, **_base_moments(robot, joints, covariates.get(PAYLOAD)))


def torque_columns(joints: int) -> list[str]:
    """Return the columns of views.csv in which drives report their torques, N·m."""
    return [f"j{i + 1}_torque_nm" for i in range(joints)]


def no_torques(count: int) -> Torques:
    """Return the torques at `count` views of an arm that nobody knows."""
    return Torques((), (), np.zeros((count, 0)))
