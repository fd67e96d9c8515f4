"""The contact frame of a clamp from its three pads (three-point method)."""

import numpy as np

from stitch import frames
from stitch.frames import Array


def contact_frame(points: Array) -> Array:
    """Frames (..., 4, 4) in the frame of the points (..., 3, 3): the base's two pads, then the third one.

    Origin in the pads' centroid, x from the base's middle to the third pad, z along (p3 − p1) × (p2 − p1): into the
    panel if the base's pads are listed from −y to +y as the clamp sees it.
    """
    p1, p2, p3 = np.moveaxis(np.asarray(points, float), -2, 0)
    origin = (p1 + p2 + p3) / 3
    x = _unit(p3 - (p1 + p2) / 2)
    z = _unit(np.cross(p3 - p1, p2 - p1))
    return frames.make(np.stack([x, np.cross(z, x), z], axis=-1), origin)


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
