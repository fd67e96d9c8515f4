"""The robot's base frame from outside: a marker's path while one joint turns is a circle about that joint's axis."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from stitch import frames
from stitch.errors import NoResultError
from stitch.frames import Array

# Axes closer than this (rad) to parallel leave the y axis to noise.
_PARALLEL = np.radians(5.0)


@dataclass(frozen=True)
class Circle:
    """A circle in space; the axis follows the right-hand rule along the order of the points."""

    centre: Array  # (3,)
    axis: Array  # (3,) unit vector
    radius: float
    rms: float  # of the distances from the circle, in and out of its plane


def fit_circle(points: Array) -> Circle:
    """Circle through points (N, 3): plane by SVD, then least squares of the distances within it.

    Raises:
        NoResultError: fewer than four points, or points on a line.
    """
    points = np.asarray(points, float)
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
    if len(points) < 4 or spread[1] < 1e-6 * spread[0]:
        raise NoResultError(
            "a circle needs four or more marker positions that do not lie on a line; turn the joint further"
        )
    flat = (points - middle) @ axes[:2].T
    # Algebraic circle |p|² = 2 c·p + k as a start.
    solved = np.linalg.lstsq(np.column_stack([2 * flat, np.ones(len(flat))]), (flat**2).sum(axis=1), rcond=None)[0]
    start = np.append(solved[:2], np.sqrt(max(solved[2] + solved[:2] @ solved[:2], 0.0)))
    x = least_squares(lambda c: np.linalg.norm(flat - c[:2], axis=1) - c[2], start, method="lm").x
    centre = middle + x[:2] @ axes[:2]
    arms = points - centre
    swept = np.cross(arms[:-1], arms[1:]).sum(axis=0)
    axis = axes[2] * np.sign(axes[2] @ swept)
    out = np.column_stack([np.linalg.norm(flat - x[:2], axis=1) - x[2], arms @ axis])
    return Circle(centre, axis, float(x[2]), float(np.sqrt((out**2).sum(axis=1).mean())))


def base_frame(joint6_path: Array, joint1_path: Array, height_joint6: float = 0.0) -> Array:
    """T_measuring_base (4, 4) from marker paths (N, 3) in the measuring system, at the home pose.

    The axis of joint 6 is x, that of joint 1 is z, y = z × x (source, formulas 1 and 2). The origin lies on the axis
    of joint 1, `height_joint6` below the axis of joint 6. The paths run in the right-hand sense of x and z.

    Raises:
        NoResultError: a path is no circle, or both axes are parallel.
    """
    about_x, about_z = fit_circle(joint6_path), fit_circle(joint1_path)
    z = about_z.axis
    y = np.cross(z, about_x.axis)
    if np.linalg.norm(y) < np.sin(_PARALLEL):
        raise NoResultError("the axes of joint 1 and joint 6 are parallel at this pose; move to the home pose")
    y /= np.linalg.norm(y)
    x = np.cross(y, z)
    # The foot of the common normal: c1 + a z and c6 + b x6 at their closest.
    between = about_x.centre - about_z.centre
    foot = np.linalg.lstsq(np.column_stack([z, -about_x.axis]), between, rcond=None)[0][0]
    origin = about_z.centre + (foot - height_joint6) * z
    return frames.make(np.column_stack([x, y, z]), origin)
