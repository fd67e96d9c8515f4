"""From where the part is looked at: what is long stands upright, and the side that shows most comes to the front."""

from typing import NamedTuple

import numpy as np

from stitch.frames import Array

_ELEVATION = np.radians(18.0)
# A part this much longer than wide stands upright although nobody knows where up is.
_LONG = 1.4


class Camera(NamedTuple):
    """Unit vectors in the reference frame."""

    right: Array  # (3,)
    up: Array  # (3,)
    towards: Array  # (3,) from the part to the eye

    @property
    def axes(self) -> Array:
        """(3, 3) rows right, up, towards: part coordinates to the screen's."""
        return np.array([self.right, self.up, self.towards])


def camera_for(points: Array, normals: Array, upright: bool) -> Camera:
    """A camera for points (N, 3) with unit normals (N, 3).

    Args:
        upright: z of the reference frame is up, as in the base of a robot; else what is long stands upright.
    """
    up = np.array([0.0, 0.0, 1.0])
    if not upright:
        values, vectors = np.linalg.eigh(np.cov((points - points.mean(axis=0)).T))
        if values[2] > _LONG**2 * values[1]:
            up = vectors[:, 2] * (1.0 if vectors[2, 2] >= 0 else -1.0)
    aside = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    aside /= np.linalg.norm(aside)
    ahead = np.cross(aside, up)
    best, camera = -1.0, None
    for angle in np.radians(np.arange(0, 360, 15)):
        level = np.cos(angle) * aside + np.sin(angle) * ahead
        towards = np.cos(_ELEVATION) * level + np.sin(_ELEVATION) * up
        shown = float(np.maximum(normals @ towards, 0).sum())
        if shown > best:
            right = np.cross(up, towards)
            right /= np.linalg.norm(right)
            best, camera = shown, Camera(right, np.cross(towards, right), towards)
    assert camera is not None
    return camera
