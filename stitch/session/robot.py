"""Serial robots: forward kinematics, joint axes, Jacobian and gravity torques, vectorised over poses.

One joint is `before · Rz(q + theta) · after`: standard DH has before = 1 and after = Tz(d)Tx(a)Rx(α)
(Denavit & Hartenberg 1955), modified DH before = Rx(α)Tx(a) and after = Tz(d) (Craig 1986), URDF
before = origin with the joint axis turned to z and after = its inverse turn.

Of an arm whose links are a little wrong (`Links`): where its flange truly is, and how that answers to every error.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stitch.numerics.frames import Array

# Columns of a frame.
_X = 0
_Z = 2


@dataclass(frozen=True)
class LinkMesh:
    """How a link looks, for pictures alone."""

    link: int  # 0 is the base, i what joint i moves: its frame is that of `link_frames`, the flange's for the last
    T_link_mesh: Array  # (4, 4) length_unit
    file: Path
    scale: Array  # (3,) length_unit in a unit of the file


@dataclass(frozen=True)
class Robot:
    """A chain of n revolute joints. Lengths in length_unit, angles in rad, masses in kg."""

    name: str
    convention: str  # standard | modified | urdf
    before: Array  # (n, 4, 4)
    after: Array  # (n, 4, 4)
    theta: Array  # (n,) offset added to the joint angle
    mass: Array  # (n,) of link i, which joint i moves
    com: Array  # (n, 3) in the link's own frame, after joint i
    payload_mass: float
    payload_com: Array  # (3,) in the flange frame
    gravity: Array  # (3,) m/s² in the base frame
    metres_per_unit: float
    a: Array | None = None  # (n,) DH parameters, None for URDF
    alpha: Array | None = None
    d: Array | None = None
    meshes: tuple[LinkMesh, ...] = ()

    @property
    def n_joints(self) -> int:
        return len(self.theta)

    @property
    def has_masses(self) -> bool:
        """True if masses of links are known; what the flange carries is not what the arm itself weighs."""
        return bool(self.mass.any())

    @property
    def carries_at_flange(self) -> bool:
        """True if no centre of mass of a payload is known: it counts at the flange's origin."""
        return not self.payload_com.any()


def elementary(axis: str, angle: Array | float = 0.0, shift: Array | float = 0.0) -> Array:
    """Return transforms (..., 4, 4) that turn about and shift along one coordinate axis.

    Args:
        axis: x | y | z.
        angle: (...) rad.
        shift: (...) length_unit.
    """
    angle, shift = np.broadcast_arrays(np.asarray(angle, float), np.asarray(shift, float))
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    T = np.zeros((*angle.shape, 4, 4))
    T[..., i, i] = T[..., 3, 3] = 1.0
    T[..., j, j] = T[..., k, k] = np.cos(angle)
    T[..., k, j] = np.sin(angle)
    T[..., j, k] = -T[..., k, j]
    T[..., i, 3] = shift
    return T


def link_frames(robot: Robot, joints: Array) -> Array:
    """Return T_base_link (..., n+1, 4, 4) for joint angles (..., n) in rad; index 0 is the base itself."""
    joints = np.asarray(joints, float)
    out = [np.broadcast_to(np.eye(4), (*joints.shape[:-1], 4, 4))]
    for i in range(robot.n_joints):
        turn = elementary("z", joints[..., i] + robot.theta[i])
        out.append(out[-1] @ robot.before[i] @ turn @ robot.after[i])
    return np.stack(out, axis=-3)


def forward(robot: Robot, joints: Array) -> Array:
    """Return T_base_flange (..., 4, 4) for joint angles (..., n) in rad."""
    return link_frames(robot, joints)[..., -1, :, :]


def joint_axes(robot: Robot, joints: Array) -> tuple[Array, Array]:
    """Return a point on each joint axis and its direction, both (..., n, 3), in the base frame."""
    axis_frame = link_frames(robot, joints)[..., :-1, :, :] @ robot.before
    return axis_frame[..., :3, 3], axis_frame[..., :3, 2]


def jacobian(robot: Robot, joints: Array) -> Array:
    """Return J (..., 6, n) with T_base_flange(q + dq) ≈ T_base_flange(q)·exp(J dq), for joint angles (..., n) rad.

    Twists in the flange frame, rotation first: rad and length_unit per rad. The columns are the joints' screws in that
    frame (Lynch & Park, *Modern Robotics*, 5.1.2).
    """
    point, axis = joint_axes(robot, joints)
    T = forward(robot, joints)
    lever = T[..., None, :3, 3] - point
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)[..., None, :, :]
    turned = [(Rt @ v[..., None])[..., 0] for v in (axis, np.cross(axis, lever))]
    return np.swapaxes(np.concatenate(turned, axis=-1), -1, -2)


def torques_per_kg(robot: Robot, joints: Array, places: Array) -> Array:
    """Return torques of gravity (..., n, k), N·m, about +z of joint i of 1 kg at place j: z_i · (p_j − o_i) × g.

    Place j moves with link j, one beyond the last with the flange: 0 where joint i does not carry it, j < i.

    Args:
        joints: (..., n) rad.
        places: (..., k, 3) base frame.
    """
    point, axis = joint_axes(robot, joints)
    lever = places[..., None, :, :] - point[..., :, None, :]
    torque = np.einsum("...ij,...ikj->...ik", axis, np.cross(lever, robot.gravity))
    is_carried = np.arange(places.shape[-2]) >= np.arange(robot.n_joints)[:, None]
    return torque * robot.metres_per_unit * is_carried


def unit_torques(robot: Robot, joints: Array) -> Array:
    """Return torques of gravity (..., n, n), N·m, about joint i of 1 kg at the origin of link k, at joints (..., n)."""
    return torques_per_kg(robot, joints, link_frames(robot, joints)[..., 1:, :3, 3])


def base_moments(robot: Robot, joints: Array) -> Array:
    """Return (..., n+1, 3) N·m about the base's axes of 1 kg at the centre of mass of each link, the payload's last."""
    return np.cross(mass_centres(robot, joints), robot.gravity) * robot.metres_per_unit


def mass_centres(robot: Robot, joints: Array) -> Array:
    """Return centres of mass (..., n+1, 3), base frame: of each link, then of the payload, at joints (..., n) rad.

    Where the robot states none it is the origin of the link's frame, or of the flange.
    """
    link = link_frames(robot, joints)[..., 1:, :, :]
    bodies = np.concatenate([link, link[..., -1:, :, :]], axis=-3)
    com = np.vstack([robot.com, robot.payload_com])
    return (bodies[..., :3, :3] @ com[..., None])[..., 0] + bodies[..., :3, 3]


def payload_torques(robot: Robot, joints: Array) -> Array:
    """Return (..., n) N·m about +z of every joint of 1 kg at the payload's centre of mass, at joints (..., n) rad."""
    return torques_per_kg(robot, joints, mass_centres(robot, joints))[..., -1]


def gravity_torques(robot: Robot, joints: Array) -> Array:
    """Return torques of gravity about +z of every joint (..., n), N·m: z_i · Σ (c − o_i) × m g over what it carries.

    Minus the gradient of the potential energy V = −Σ m g·c; a drive holds the opposite. Links and payload count; zeros
    without masses.

    Args:
        joints: (..., n) rad.
    """
    return torques_per_kg(robot, joints, mass_centres(robot, joints)) @ np.append(robot.mass, robot.payload_mass)


@dataclass(frozen=True)
class Links:
    """Errors of an arm's links in V views: factors on lengths, and additions to the Denavit–Hartenberg parameters.

    Of a URDF arm the additions act after the joint, in the frame whose z is its axis: along x, along z, about x.
    """

    scale: Array  # (V,) factor on all lengths
    lengths: Array  # (V, n) factor on the lengths of each link
    da: Array  # (n,) length_unit
    dd: Array  # (n,) length_unit
    dalpha: Array  # (n,) rad


@dataclass(frozen=True)
class FlangeSlopes:
    """Derivatives of the flange's pose: twists in its frame, T·exp(slope·error), rotation first, per unit of error."""

    joints: Array  # (V, 6, n)
    scale: Array  # (V, 6)
    lengths: Array  # (V, 6, n)
    da: Array  # (V, 6, n)
    dd: Array  # (V, 6, n)
    dalpha: Array  # (V, 6, n)

    def twists(self, joints: Array, links: Links) -> Array:
        """Return twists (V, 6) of the flange, in its frame, for small changes of joint angles (V, n) rad and links.

        Args:
            links: changes of all factors and additions; a `scale` of 0 means no change.
        """
        rows = np.einsum("vki,i->vk", self.da, links.da) + np.einsum("vki,i->vk", self.dd, links.dd)
        rows += np.einsum("vki,i->vk", self.dalpha, links.dalpha)
        rows += np.einsum("vki,vi->vk", self.lengths, links.lengths)
        return np.einsum("vki,vi->vk", self.joints, joints) + self.scale * links.scale[:, None] + rows


def exact_links(count: int, joints: int) -> Links:
    """Return the links of an arm without any error, for `count` views."""
    return Links(np.ones(count), np.ones((count, joints)), *np.zeros((3, joints)))


def forward_with_errors(robot: Robot, joints: Array, links: Links) -> Array:
    """Return T_base_flange (V, 4, 4) of an arm with such links, for joint angles (V, n) in rad."""
    return _chain(robot, joints, links)[-1].end


def flange_slopes(robot: Robot, joints: Array, links: Links) -> FlangeSlopes:
    """Return the derivatives of the flange's pose by joint angles and link errors, at joints (V, n) rad and `links`.

    Each error is a screw in a frame of the chain, expressed in the flange frame (Lynch & Park, *Modern Robotics*,
    5.1.2).
    """
    # Of all links at once, (n, V, …).
    before, turned, end, reach = (np.array(arrays) for arrays in zip(*_chain(robot, joints, links), strict=True))
    modified = robot.convention == "modified"
    T, still = end[-1], np.zeros_like(reach)
    row = before if modified else end  # the frame along whose x axis da and dalpha act
    # d lies along z of the joint after its rotation, in the modified convention along z of the link's end.
    along_d = (end if modified else turned)[..., :3, _Z]
    # Additions to a and d are lengths of the link: the factors multiply them too.
    stretch = (links.scale[:, None] * links.lengths).T[..., None]
    longer = _screws(T, end, still, reach)
    slopes = {
        "joints": _screws(T, turned, turned[..., :3, _Z], still),
        "lengths": longer / links.lengths.T[..., None],
        "da": _screws(T, row, still, stretch * row[..., :3, _X]),
        "dd": _screws(T, end, still, stretch * along_d),
        "dalpha": _screws(T, row, row[..., :3, _X], still),
    }
    scale = longer.sum(axis=0) / links.scale[:, None]
    return FlangeSlopes(scale=scale, **{name: np.stack([*by_joint], axis=-1) for name, by_joint in slopes.items()})


class _Link(NamedTuple):
    """One link of a chain in V views, base frame."""

    before: Array  # (V, 4, 4) T_base_joint, before the joint's rotation
    turned: Array  # (V, 4, 4) the same after the rotation
    end: Array  # (V, 4, 4) T_base_link, where the next joint begins
    reach: Array  # (V, 3) part of the way from the last link's end to this one's that its lengths make


def _chain(robot: Robot, joints: Array, links: Links) -> list[_Link]:
    """Return the n links of an arm with errors, at joint angles (V, n) rad.

    T_base_end = T_last_end · before · Rz(q + theta) · after, with the errors where the convention has its parameters.
    """
    x_error = elementary("x", links.dalpha, links.da)
    z_error = elementary("z", 0, links.dd)
    T = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    chain = []
    for i in range(robot.n_joints):
        before, after = robot.before[i], z_error[i] @ robot.after[i] @ x_error[i]
        if robot.convention == "modified":
            before, after = robot.before[i] @ x_error[i], robot.after[i] @ z_error[i]
        scale = links.scale * links.lengths[:, i]
        first = T @ _scaled(before, scale)
        turned = first @ elementary("z", joints[:, i] + robot.theta[i])
        last = turned @ _scaled(after, scale)
        reach = first[:, :3, 3] - T[:, :3, 3] + last[:, :3, 3] - turned[:, :3, 3]
        chain.append(_Link(first, turned, last, reach))
        T = last
    return chain


def _scaled(T: Array, scale: Array) -> Array:
    """Return a transform T (4, 4) V times, its translation multiplied by `scale` (V,): (V, 4, 4)."""
    out = np.tile(T, (len(scale), 1, 1))
    out[:, :3, 3] *= scale[:, None]
    return out


def _screws(T_base_flange: Array, at: Array, turn: Array, shift: Array) -> Array:
    """Return twists (n, V, 6) of the flange, in its frame, by rotations and shifts at other frames of the chain.

    Args:
        T_base_flange: (V, 4, 4).
        at: (n, V, 4, 4) T_base_frame; their origins are what the rotations are about.
        turn, shift: (n, V, 3) rad and length_unit, base frame.
    """
    lever = T_base_flange[:, :3, 3] - at[..., :3, 3]
    moved = np.stack([turn, np.cross(turn, lever) + shift], axis=-2)
    # Rows times the rotation of the flange: its inverse turns them.
    return (moved @ T_base_flange[:, :3, :3]).reshape(*turn.shape[:-1], 6)
