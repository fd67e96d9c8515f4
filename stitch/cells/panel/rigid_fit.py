"""A rigid body's pose from measured points, with covariance."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.cells.point_alignment import align_points, on_a_line
from stitch.errors import NoResultError
from stitch.frames import Array


@dataclass(frozen=True)
class RigidFit:
    """T_to_from and the residual of every point."""

    T: Array  # (4, 4)
    covariance: Array  # (6, 6) of the twist ξ in T·exp(ξ), rotation first, about the points' centroid
    residuals: Array  # (N, 3) measured minus fitted, frame `to`


def rigid_fit(nominal: Array, measured: Array, sigma: Array) -> RigidFit:
    """The motion that takes nominal points (N, 3) onto measured ones (N, 3), each with its sigma (N,).

    Kabsch/Wahba solution (Horn 1987). All points count alike: a body that is millimetres out of shape would move by
    more than its targets' noise if the targets near the tracker counted for more. The sigmas make the covariance.

    Raises:
        NoResultError: fewer than three points, or all on one line.
    """
    nominal, measured = np.asarray(nominal, float), np.asarray(measured, float)
    if len(nominal) < 3:
        raise NoResultError(f"{len(nominal)} points fix no pose; measure at least three that are not on a line")
    if on_a_line(nominal):
        raise NoResultError("all points lie on one line: the turn about it is open; measure a point off the line")
    T = align_points(nominal, measured)
    arms = nominal - nominal.mean(axis=0)
    design = np.concatenate([-frames.skew(arms), np.tile(np.eye(3), (len(arms), 1, 1))], axis=-1)
    gain = np.linalg.pinv(design.reshape(-1, 6)) * np.repeat(np.asarray(sigma, float), 3)
    return RigidFit(T, gain @ gain.T, measured - frames.transform(T, nominal))
