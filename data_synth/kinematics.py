"""Where an arm's flange is, what gravity does to its joints, and joint angles for a wanted pose."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from data_synth.arms import Arm

Array = NDArray[np.float64]

GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s², base frame
_ANGLE_STEP = 1e-5  # rad, for the slope of potential energy
_LEVER = 300.0  # mm: a radian of orientation error counts as much as this in position
_CLOSE = 1e-6  # mm: a pose is reached
_NEWTON_STEPS = 8


def links(arm: Arm, q: Array) -> Array:
    """(..., n + 1, 4, 4): base and the DH frames of all links, for joint angles q (..., n)."""
    q = np.asarray(q, float)
    angle = q + arm.theta
    c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(arm.alpha), np.sin(arm.alpha)
    step = np.zeros((*q.shape, 4, 4))
    step[..., 0, 0], step[..., 0, 1], step[..., 0, 2], step[..., 0, 3] = c, -s * ca, s * sa, arm.a * c
    step[..., 1, 0], step[..., 1, 1], step[..., 1, 2], step[..., 1, 3] = s, c * ca, -c * sa, arm.a * s
    step[..., 2, 1], step[..., 2, 2], step[..., 2, 3] = sa, ca, arm.d
    step[..., 3, 3] = 1.0
    frames = np.empty((*q.shape[:-1], arm.joints + 1, 4, 4))
    frames[..., 0, :, :] = np.eye(4)
    for i in range(arm.joints):
        frames[..., i + 1, :, :] = frames[..., i, :, :] @ step[..., i, :, :]
    return frames


def flange(arm: Arm, q: Array) -> Array:
    """T_base_flange (..., 4, 4)."""
    return np.asarray(links(arm, q)[..., -1, :, :])


def potential_energy(arm: Arm, q: Array) -> Array:
    """Joule (...): −Σ m g·c over links and payload."""
    return np.asarray(-(mass_moment(arm, q) @ GRAVITY) / 1000.0)


def mass_moment(arm: Arm, q: Array) -> Array:
    """Sum of m·c over links and payload, kg mm (..., 3), base frame."""
    frames = links(arm, q)
    centres = np.einsum("...nij,nj->...ni", frames[..., 1:, :3, :3], arm.com) + frames[..., 1:, :3, 3]
    load = frames[..., -1, :3, :3] @ np.array(arm.payload_com) + frames[..., -1, :3, 3]
    return np.asarray(np.einsum("n,...ni->...i", arm.mass, centres) + arm.payload_mass * load)


def base_moments(arm: Arm, q: Array) -> Array:
    """N·m (..., 2) about the base's x and y: minus the slope of potential energy as the whole arm turns about them."""
    turned = Rotation.from_rotvec(np.vstack([np.eye(3)[:2], -np.eye(3)[:2]]) * _ANGLE_STEP).as_matrix()
    energy = -np.einsum("kij,...j,i->...k", turned, mass_moment(arm, q), GRAVITY) / 1000.0
    return np.asarray((energy[..., 2:] - energy[..., :2]) / (2 * _ANGLE_STEP))


def gravity_torques(arm: Arm, q: Array) -> Array:
    """N·m (..., n) about +z of every joint: minus the slope of potential energy."""
    q = np.asarray(q, float)
    steps = np.eye(arm.joints) * _ANGLE_STEP
    rise = potential_energy(arm, q[..., None, :] + steps) - potential_energy(arm, q[..., None, :] - steps)
    return np.asarray(-rise / (2 * _ANGLE_STEP))


def inverse(arm: Arm, T_base_flange: Array, near: Array) -> Array | None:
    """Joint angles (n,) within limits that put the flange at the pose; None if there is no way from `near` or home.

    The solution found from `near` is taken first: arms keep their configuration and move as little as they can.
    """
    margin = np.radians(2.0)
    lower, upper = arm.lower + margin, arm.upper - margin
    towards = arm.home.copy()
    towards[0] = np.arctan2(T_base_flange[1, 3], T_base_flange[0, 3])
    for start in (near, arm.home, towards):
        start = np.clip(start, lower, upper)
        found = least_squares(_off, start, _slope, args=(arm, T_base_flange), bounds=(lower, upper), max_nfev=40)
        q = found.x
        # With a joint to spare the search above creeps along its valley; short Newton steps end it.
        for _ in range(_NEWTON_STEPS):
            off = _off(q, arm, T_base_flange)
            if np.abs(off).max() < _CLOSE:
                return np.asarray(q)
            q = np.clip(q - np.linalg.lstsq(_slope(q, arm, T_base_flange), off, rcond=None)[0], lower, upper)
    return None


def velocity(arm: Arm, q: Array, v: Array) -> Array:
    """Smallest joint velocities (n,) rad/s at q that move the flange by v (3,) mm/s in its own frame, unturned."""
    here = flange(arm, q)
    wanted = np.append(np.zeros(3), here[:3, :3] @ v)
    return np.asarray(np.linalg.lstsq(_slope(q, arm, here), wanted, rcond=None)[0])


def _off(q: Array, arm: Arm, wanted: Array) -> Array:
    """(6,) rotation (mm, at the lever) and position from the wanted flange to that at q (n,)."""
    T = flange(arm, q)
    return np.concatenate([_turn(wanted, T) * _LEVER, T[:3, 3] - wanted[:3, 3]])


def _slope(q: Array, arm: Arm, wanted: Array) -> Array:
    """(6, n) change of `_off` a radian of every joint: each turns what follows about its own z axis."""
    frames = links(arm, q)
    axes = frames[:-1, :3, 2]
    x, y, z = turn = _turn(wanted, frames[-1])
    # What a small turn after another changes of the rotation vector.
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.sqrt(turn @ turn)
    share = 1 / 12 if angle < 1e-3 else (1 - angle / 2 / np.tan(angle / 2)) / angle**2
    turned = (np.eye(3) - across / 2 + share * across @ across) @ wanted[:3, :3].T @ axes.T
    arms = frames[-1, :3, 3] - frames[:-1, :3, 3]
    moved = axes[:, [1, 2, 0]] * arms[:, [2, 0, 1]] - axes[:, [2, 0, 1]] * arms[:, [1, 2, 0]]
    return np.concatenate([turned * _LEVER, moved.T])


def _turn(wanted: Array, T: Array) -> Array:
    """Rotation vector (3,) rad from the wanted flange to another, in the wanted one's frame."""
    R = wanted[:3, :3].T @ T[:3, :3]
    across = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = np.sqrt(across @ across)
    angle = np.arctan2(sine, (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2)
    return across * (angle / sine if sine > 1e-12 else 1.0)
