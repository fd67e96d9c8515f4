"""Robust weights of whole cells of the surface: a cell's mean shows a shift that no single point can."""

import numpy as np
from numpy.typing import NDArray

from stitch.cells.window.biweight import MAD, TUKEY, biweight
from stitch.cells.window.cad import NearestPartners
from stitch.frames import Array

# Cells with fewer points have no mean worth judging; their points keep their own weights.
_MIN_CELL_POINTS = 5


def cell_weights(points: Array, partners: NearestPartners, used: NDArray[np.bool_], cell: float, scale: float) -> Array:
    """(N,) weight of each point's cell: a cube of edge `cell` (part frame) and a side that its points look to.

    The scale is the cells' own spread (median), at least what the points' `scale` leaves in a mean: where a scan is
    only as good as its robot, all cells are off a little and none is thrown out for it.
    """
    key = np.hstack([np.floor(points / cell), np.round(partners.normal)]).astype(np.int64)
    _, where = np.unique(key, axis=0, return_inverse=True)
    where = where.ravel()
    count = np.bincount(where, used)
    mean = np.bincount(where, used * partners.distance) / np.maximum(count, 1)
    full = count >= _MIN_CELL_POINTS
    if not full.any():
        return np.ones(len(points))
    floor = scale / np.sqrt(np.median(count[full]))
    spread = max(MAD * float(np.median(np.abs(mean[full]))), float(floor))
    weight = np.where(full, biweight(mean / (TUKEY * spread)), 1.0)
    return np.asarray(weight[where])
