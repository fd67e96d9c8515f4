"""Frames and Euler angles of holes."""

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array


def hole_rotation(direction: Array) -> Array:
    """R_base_hole (..., 3, 3): z = hole direction, x = (z2, −z1, 0)/norm, y = z × x (source, formulas 6 to 9).

    The x axis of a vertical hole, which the formula leaves open, is the x axis of the base.
    """
    z = np.asarray(direction, float)
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    x = np.stack([z[..., 1], -z[..., 0], np.zeros_like(z[..., 0])], axis=-1)
    size = np.linalg.norm(x, axis=-1, keepdims=True)
    x = np.where(size > 1e-9, x / np.maximum(size, 1e-9), [1.0, 0.0, 0.0])
    return np.asarray(np.stack([x, np.cross(z, x), z], axis=-1))


def drive_pose(position: Array, direction: Array) -> Array:
    """T_base_tool (..., 4, 4) that puts the tool on a hole."""
    return frames.make(hole_rotation(direction), position)


def euler_zyx(R: Array) -> Array:
    """Angles (..., 3) in rad about z, y', x'' (A, B, C of a KUKA controller): R = Rz(A) Ry(B) Rx(C)."""
    R = np.asarray(R, float)
    return np.asarray(Rotation.from_matrix(R.reshape(-1, 3, 3)).as_euler("ZYX").reshape(*R.shape[:-2], 3))
