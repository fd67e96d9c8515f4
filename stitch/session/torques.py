"""Torques that bend the joints of an arm at its views, as drives report them, else those of gravity; and the moments of
arm and load that tilt its base."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from stitch.numerics.frames import Array
from stitch.session import robot as kinematics
from stitch.session.robot import Robot
from stitch.system.values import take_rows

PAYLOAD = "payload_kg"  # column: what the flange carries, at the centre of mass of [robot] payload, else at the flange
# So many joint angles show which torques of an arm differ.
_ANYWHERE = 100
STILL = 1e-3  # N·m of 1 kg: an axis that gravity does not bend


@dataclass(frozen=True)
class Torques:
    """Torques under which joints sag: with masses one a joint, without them one a joint and a link beyond."""

    names: tuple[str, ...]
    joint: tuple[int, ...]  # that the torque bends
    values: Array  # (V, m) N·m about +z of that joint; of 1 kg at the link's frame where masses are unknown
    measured: bool = False
    # Moments about the base's axes x and y: of arm and load where masses are known, else of 1 kg at each link's frame.
    base_names: tuple[str, ...] = ()  # _x, _y; without masses _x_3 of link 3, and _x, _y of a load that is known
    base_axis: tuple[int, ...] = ()
    base: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (V, k) N·m

    def only(self, keep: Sequence[int]) -> "Torques":
        """Return those of some of the views."""
        return take_rows(self, keep, *(["values", "base"] if self.base_names else ["values"]))

    def followed_by(self, later: "Torques") -> "Torques":
        """Return those of these views and of later ones."""
        base = np.concatenate([self.base, later.base]) if self.base_names else self.base
        return replace(self, values=np.concatenate([self.values, later.values]), base=base)


def torques_of(robot: Robot, joints: Array, payload: Array | None = None) -> Torques:
    """Return gravity torques, N·m, at joint angles (V, n), rad; of 1 kg a link where masses are not known.

    Which torques are listed depends on the arm alone, not on the angles.

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
    # What the links weigh nobody knows, what they carry is known: a coefficient of its own for every joint it bends.
    links = _unit_link_torques(robot, joints)
    shapes = kinematics.payload_torques(robot, _sample_joints(robot))
    bent = np.flatnonzero(np.ptp(shapes, axis=0) > STILL).tolist()
    names = (*links.names, *(str(i + 1) for i in bent))
    values = np.hstack([links.values, carried[:, bent]])
    return Torques(names, (*links.joint, *bent), values, **of_base)


def _base_moments(robot: Robot, joints: Array, payload: Array | None) -> dict[str, Any]:
    """Return the fields of `Torques` that say what tilts the base."""
    of_kg = kinematics.base_moments(robot, joints)[..., :2]
    load = np.full(len(joints), robot.payload_mass) if payload is None else payload
    moments = load[:, None] * of_kg[:, -1]
    columns = list[tuple[str, int, Array]]()
    if robot.has_masses:
        moments = moments + np.einsum("k,vki->vi", robot.mass, of_kg[:, :-1])
    else:
        shapes = kinematics.base_moments(robot, _sample_joints(robot))[:, :-1]
        links = [(i, k) for i in range(2) for k in _independent_links(shapes[..., i], range(robot.n_joints))]
        columns = [(f"_{'xy'[i]}_{k + 1}", i, of_kg[:, k, i]) for i, k in links]
    if robot.has_masses or load.any():
        columns += [(f"_{'xy'[i]}", i, moments[:, i]) for i in range(2)]
    values = np.array([value for *_, value in columns]).T.reshape(len(joints), len(columns))
    return {"base_names": tuple(c[0] for c in columns), "base_axis": tuple(c[1] for c in columns), "base": values}


def _each_joint(values: Array) -> Torques:
    joints = range(values.shape[1])
    return Torques(tuple(str(i + 1) for i in joints), tuple(joints), values)


def _unit_link_torques(robot: Robot, joints: Array) -> Torques:
    """Return torques, N·m, of 1 kg at the frame of link k about joint i, named i_k, one for each independent pair.

    Without masses their shapes over the views alone are known.
    """
    n = robot.n_joints
    shapes = kinematics.unit_torques(robot, _sample_joints(robot))
    keep = [(i, k) for i in range(n) for k in _independent_links(shapes[:, i], range(i, n))]
    unit = kinematics.unit_torques(robot, joints)
    values = np.array([unit[:, i, k] for i, k in keep]).T.reshape(len(joints), len(keep))
    return Torques(tuple(f"{i + 1}_{k + 1}" for i, k in keep), tuple(i for i, _ in keep), values)


def _independent_links(torques: Array, links: Sequence[int]) -> list[int]:
    """Return the links whose unit torque (V, n) about one joint changes and is no combination of those before it.

    Frames of a wrist share their origin: a second torque from the same place would only make both unknown.
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
    """Return (N, n) joint angles from everywhere: a coefficient must mean the same in every session of an arm."""
    return np.random.default_rng(0).uniform(-np.pi, np.pi, (_ANYWHERE, robot.n_joints))


def torques_of_views(robot: Robot, joints: Array, covariates: Mapping[str, Array]) -> Torques:
    """Return the torques at joint angles (V, n), as drives report them or of gravity.

    Args:
        covariates: (V,) by name: jN_torque_nm of all joints is what drives report, payload_kg what the flange carries.
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
