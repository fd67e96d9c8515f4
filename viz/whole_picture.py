"""An eye of the viewer from which everything is in the picture, and in its middle."""

import os

import numpy as np

from stitch.frames import Array

os.environ.setdefault("RERUN_ANALYTICS", "off")
import rerun.blueprint as rrb

# Tangent of half the viewer's field, 55 degrees high, with a margin.
_HIGH = 0.47


def eye_for(points: Array, axes: Array, up: Array, aspect: float) -> rrb.EyeControls3D:
    """The nearest eye that sees all points (N, 3).

    Args:
        axes: (3, 3) rows right, up, and from the points to the eye: unit vectors.
        up: (3,) about which the picture is turned.
        aspect: width of the window over its height.
    """
    middle, half = (points.min(axis=0) + points.max(axis=0)) / 2, np.array([aspect * _HIGH, _HIGH])
    for _ in range(4):
        x, y, z = axes @ (points - middle).T
        away = float(np.max(z + np.maximum(np.abs(x) / half[0], np.abs(y) / half[1])))
        seen = np.array([x, y]) / (away - z)
        middle = middle + 0.5 * away * (seen.min(axis=1) + seen.max(axis=1)) @ axes[:2]
    return rrb.EyeControls3D(position=middle + away * axes[2], look_target=middle, eye_up=up)
