"""Hand-eyes from the clouds' centroids, as crude labelled points of one fixed target."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture

_STARTS = 24


def scanner_centre(captures: Sequence[Capture]) -> Array:
    """Mean centroid of the scans in the scanner frame (3,)."""
    return np.asarray(np.mean([scan.points.mean(axis=0) for c in captures for scan in c.scans], axis=0))


def centroid_hand_eyes(captures: Sequence[Capture]) -> list[Array]:
    """Hand-eyes (4, 4) that bring the clouds' centroids of each capture to one point, best first.

    The centroid of a view leans to the side it sees, so this is coarse: 2–17° and 20–60 mm.
    """
    centroids = [np.array([s.points.mean(axis=0) for s in c.scans]) for c in captures]

    def residual(x: Array) -> Array:
        T = frames.make(Rotation.from_rotvec(x[:3]).as_matrix(), x[3:])
        rows = []
        for c, centroid in zip(captures, centroids, strict=True):
            placed = frames.transform(c.poses(T), centroid[:, None])[:, 0]
            rows.append((placed - placed.mean(axis=0)).ravel())
        return np.concatenate(rows)

    fits = []
    for start in Rotation.random(_STARTS, rng=np.random.default_rng(0)):
        fit = least_squares(residual, np.r_[start.as_rotvec(), np.zeros(3)], method="trf", max_nfev=100, x_scale="jac")
        fits.append((float(fit.cost), fit.x))
    fits.sort(key=lambda pair: pair[0])
    found: list[Array] = []
    for _, x in fits:
        T = frames.make(Rotation.from_rotvec(x[:3]).as_matrix(), x[3:])
        if all(np.degrees(frames.angle_between(T, other)) > 3 for other in found):
            found.append(T)
    return found
