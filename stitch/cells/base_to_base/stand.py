"""The stand and what was read on it.

Stand frame S: origin at slide zero, x along the rail away from P1, z the pivot axis of the rod, y = z × x.
At angle 0 the rod lies on the rail and points back to P1, towards −x.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.frames import Array


@dataclass(frozen=True)
class TouchedPoints:
    """Points that one robot touched, in its own base frame, with their covariance."""

    names: tuple[str, ...]
    points: Array  # (N, 3), length unit
    covariance: Array  # (N, 3, 3)


@dataclass(frozen=True)
class Stand:
    """Everything that was read. Lengths in length_unit, angles in rad.

    `rail` holds the points of the main robot, listed along the rail from P1 on; `rail_slide` the slide reading of the
    cup touched there, NaN where none was read. `rod` holds the points of the second robot, one per rod setting.
    """

    length_unit: str
    rail: TouchedPoints
    rail_slide: Array  # (N,)
    rod: TouchedPoints
    slide: Array  # (M,) position of the pivot along the rail
    angle: Array  # (M,) from the rail
    length: Array  # (M,) pivot to cup
    turn: float  # +1: the angle grows clockwise seen from above, −1: anticlockwise
    sigma_slide: float
    sigma_angle: float
    sigma_length: float
    sigma_level_stand: float  # how well the rod's swing is horizontal across the rail
    sigma_level_base: float | None  # how well the two bases are parallel in tilt; None: not known
    file: Path | None = None  # that was read


def cylinder_points(joint1: Array, radius: Array, height: Array) -> Array:
    """Points (N, 3) of a robot that reaches `radius` and `height` at the joint-1 angle, right-handed about z."""
    return np.stack([radius * np.cos(joint1), radius * np.sin(joint1), height], axis=-1)


def cylinder_covariance(joint1: Array, radius: Array, sigma: tuple[float, float, float]) -> Array:
    """Covariance (N, 3, 3) of `cylinder_points` from the sigmas of joint 1 (rad), radius and height."""
    c, s, zero = np.cos(joint1), np.sin(joint1), np.zeros_like(joint1)
    jacobian = np.stack(
        [
            np.stack([-radius * s, c, zero], -1),
            np.stack([radius * c, s, zero], -1),
            np.stack([zero, zero, zero + 1], -1),
        ],
        axis=-2,
    )
    return np.asarray(jacobian @ np.diag(np.square(sigma)) @ np.swapaxes(jacobian, -1, -2))


def rod_points(slide: Array, angle: Array, length: Array, turn: float) -> Array:
    """Rod cup (M, 3) in the stand frame (formulas 5 and 6 of the source, with the slide added)."""
    across = turn * length * np.sin(angle)
    return np.stack([slide - length * np.cos(angle), across, np.zeros_like(slide)], axis=-1)


def level_stand(rail: Array, rail_slide: Array) -> Array:
    """T_base1_stand (4, 4) from points (N, 3) on the rail, with the rod's swing horizontal across the rail.

    The source's choice: the line R–S of its figure 6 is perpendicular to the vertical plane through the rail.
    """
    x = rail_direction(rail)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    known = np.isfinite(rail_slide)
    origin = np.mean(rail[known] - rail_slide[known, None] * x, axis=0)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, y, np.cross(x, y)], axis=-1), origin
    return T


def rail_direction(rail: Array) -> Array:
    """(3,) unit direction of growing slide, in which the points (N, 3) are listed."""
    line = np.linalg.svd(rail - rail.mean(axis=0), full_matrices=False)[2][0]
    return np.asarray(line * np.sign(line @ (rail[-1] - rail[0])))
