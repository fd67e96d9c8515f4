"""A pose as the numbers of each controller: the way back from `taught.py`. Among numbers that mean the same pose, those
nearest to the ones before, so that a target that hardly moves hardly changes."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.frames import Array

# cos B below which A and C turn about the same axis, and one of them is free (rad).
_LOCKED = 1e-6


def zyx_numbers(T: Array, near: Array | None = None) -> Array:
    """(6,) KUKA X, Y, Z in mm, A, B, C in degrees, of a pose (4, 4) in mm."""
    return np.append(T[:3, 3], np.degrees(_zyx(T[:3, :3], None if near is None else np.radians(near[3:6]))))


def fixed_xyz_numbers(T: Array, near: Array | None = None) -> Array:
    """(6,) FANUC X, Y, Z in mm, W, P, R in degrees: the same three turns as KUKA's, written the other way round."""
    return np.append(T[:3, 3], np.degrees(_zyx(T[:3, :3], None if near is None else np.radians(near[5:2:-1])))[::-1])


def quaternion_w_first_numbers(T: Array, near: Array | None = None) -> Array:
    """(7,) ABB x, y, z in mm, q1 … q4 with q1 = w; w not negative, or the sign nearest to the one before."""
    q = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)[[3, 0, 1, 2]]
    return np.append(T[:3, 3], q if near is None or q @ near[3:7] >= 0 else -q)


def rotation_vector_numbers(T: Array, near: Array | None = None) -> Array:
    """(6,) UR x, y, z in m, rotation vector in rad, of a pose (4, 4) in mm."""
    r = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(r))
    if near is not None and angle > 0:
        # The same turn about the opposite direction, and whole turns more.
        same = [r * (1 + 2 * np.pi * k / angle) for k in (-2, -1, 0, 1)]
        r = min(same, key=lambda v: float(np.linalg.norm(v - near[3:6])))
    return np.append(T[:3, 3] / 1000, r)


NUMBERS: dict[str, Callable[..., Array]] = {
    "kuka": zyx_numbers,
    "fanuc": fixed_xyz_numbers,
    "abb": quaternion_w_first_numbers,
    "ur": rotation_vector_numbers,
}


def _zyx(R: Array, near: Array | None) -> Array:
    """(a, b, c) rad with R = Rz(a)·Ry(b)·Rx(c)."""
    b = float(np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])))
    if np.hypot(R[0, 0], R[1, 0]) < _LOCKED:
        # Only a ∓ c counts: c stays what it was.
        c = 0.0 if near is None else float(near[2])
        rest = R @ Rotation.from_euler("x", -c).as_matrix()
        return np.array([np.arctan2(-rest[0, 1], rest[1, 1]), b, c])
    first = np.array([np.arctan2(R[1, 0], R[0, 0]), b, np.arctan2(R[2, 1], R[2, 2])])
    if near is None:
        return first
    both = [first, np.array([first[0] + np.pi, np.pi - b, first[2] + np.pi])]
    return min((_within(angles, near) for angles in both), key=lambda angles: float(np.linalg.norm(angles - near)))


def _within(angles: Array, near: Array) -> Array:
    """Whole turns off, as near as can be to the angles before."""
    return np.asarray(near + (angles - near + np.pi) % (2 * np.pi) - np.pi)
