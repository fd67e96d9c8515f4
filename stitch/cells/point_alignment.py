"""The rigid motion that takes one set of points onto another."""

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array

# Points that lie within this share of their extent of one line leave the turn about it open.
_FLAT = 1e-3


def align_points(nominal: Array, measured: Array) -> Array:
    """T_measured_nominal (4, 4) by least squares of points (N, 3) each, all counting alike (Kabsch 1976)."""
    c_nominal, c_measured = nominal.mean(axis=0), measured.mean(axis=0)
    R = Rotation.align_vectors(measured - c_measured, nominal - c_nominal)[0].as_matrix()
    return frames.make(R, c_measured - R @ c_nominal)


def on_a_line(points: Array) -> bool:
    """Whether points (N, 3) lie on one line, or all in one place."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(points) < 2 or spread[1] <= _FLAT * max(spread[0], 1e-12))
