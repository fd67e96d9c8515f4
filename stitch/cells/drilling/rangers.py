"""Laser rangers on the flange: where each beam starts and points, and what several beams say about a surface."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from stitch.errors import NoResultError
from stitch.frames import Array


@dataclass(frozen=True)
class RangerFit:
    """One beam in the flange frame."""

    origin: Array  # (3,)
    direction: Array  # (3,) unit vector
    rms: float  # of the distances to the planes


@dataclass(frozen=True)
class Rangers:
    """Beams of all rangers in the flange frame."""

    origins: Array  # (n, 3)
    directions: Array  # (n, 3)


@dataclass(frozen=True)
class RangedPlane:
    """The surface under the tool, in the flange frame."""

    normal: Array  # (3,) unit vector into the part, so close to +z
    height: float  # along the tool axis

    @property
    def tilt(self) -> float:
        """Angle (rad) between tool axis and normal."""
        return float(np.arctan2(np.hypot(self.normal[0], self.normal[1]), self.normal[2]))


def fit_ranger(planes: Array, readings: Array) -> RangerFit:
    """Beam from planes (N, 4) Ax + By + Cz + D = 0 in the flange frame and the reading at each, N ≥ 6.

    Solves A(x + d nx) + B(y + d ny) + C(z + d nz) + D = 0 (source, formula 4): linear first, then with |n| = 1.

    Raises:
        NoResultError: fewer than six planes, or planes that leave the beam open.
    """
    planes, readings = np.asarray(planes, float), np.asarray(readings, float)
    planes = planes / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    normals, offsets = planes[:, :3], planes[:, 3]
    matrix = np.hstack([normals, readings[:, None] * normals])
    # Columns of unit size, so that the rank does not depend on the length unit.
    scale = np.linalg.norm(matrix, axis=0)
    if len(planes) < 6 or (scale == 0).any() or np.linalg.cond(matrix / scale) > 1e6:
        raise NoResultError(
            "six or more plane positions are needed, tilted both ways and at different distances; measure more"
        )
    start = np.linalg.lstsq(matrix, -offsets, rcond=None)[0]
    n0 = start[3:] / np.linalg.norm(start[3:])
    across = np.linalg.svd(n0[None])[2][1:]

    def direction(x: Array) -> Array:
        n = n0 + x[3:] @ across
        return np.asarray(n / np.linalg.norm(n))

    def distances(x: Array) -> Array:
        return np.asarray(((x[:3] + readings[:, None] * direction(x)) * normals).sum(axis=1) + offsets)

    x = least_squares(distances, np.append(start[:3], [0.0, 0.0]), method="lm", x_scale=[100, 100, 100, 1, 1]).x
    return RangerFit(x[:3], direction(x), float(np.sqrt(np.mean(distances(x) ** 2))))


def fit_ranged_plane(rangers: Rangers, readings: Array) -> RangedPlane:
    """Plane through the laser points of three or more readings (n,), and its height on the tool axis.

    The source takes the mean z of its four points, which is the same where the axis passes their centre.
    """
    points = rangers.origins + np.asarray(readings)[:, None] * rangers.directions
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre)[2][2]
    normal = normal * np.sign(normal[2])
    return RangedPlane(normal, float(centre @ normal / normal[2]))
