"""One edge across a seam: where the outer surface and the flank meet."""

from dataclasses import dataclass

import numpy as np

from stitch.cells.window.biweight import MAD, TUKEY, biweight, biweight_slope
from stitch.errors import NoResultError
from stitch.frames import Array

# Fewer points of a surface or flank fix no edge to a twentieth of a millimetre.
_FEWEST = 25
# Edge of the cubes whose points share what the model leaves, mm.
_CUBE = 3.0
# Points further from the edge than this say nothing about it that the surface's bend does not blur, mm.
_REACH = 22.0


@dataclass(frozen=True)
class SeamEdge:
    """In the station's frame: across the seam, height over the surface."""

    across: float
    height: float
    covariance: Array  # (2, 2) of (across, height)


def find_edge(points: Array, normals: Array, facing: float) -> SeamEdge:
    """Fit the outer surface (bent both ways) and the flank (straight down, bent along), intersect them at the station.

    Args:
        points: (N, 3) across, along and height in the station's frame, of one side of the seam only; length in mm.
        normals: (N, 3) in the same frame.
        facing: +1 if the flank looks towards positive `across`, else −1.

    Raises:
        NoResultError: the surface or the flank was not seen; names which.
    """
    up, out = normals[:, 2], facing * normals[:, 0]
    flank = points[(out > 0.75) & (up < 0.6)]
    if len(flank) < _FEWEST:
        raise NoResultError(f"{len(flank)} points on the flank; scan it leaned by 30 to 45° towards it")
    rim = np.median(flank[:, 0])
    top = points[(up > 0.85) & (np.abs(points[:, 0] - rim) < _REACH)]
    if len(top) < _FEWEST:
        raise NoResultError(f"{len(top)} points on the outer surface; scan the seam wider")
    # The flank of a bent sheet may bend too further down: only its upper part makes the edge.
    flank = flank[flank[:, 2] > np.median(top[:, 2]) - _REACH / 2]
    if len(flank) < _FEWEST:
        raise NoResultError(f"{len(flank)} points on the flank's upper part; scan it leaned by 30 to 45° towards it")
    a, s, h = top.T
    design = np.column_stack([a**0, a - rim, s, (a - rim) ** 2, s**2, (a - rim) * s])
    surface, surface_spread = _robust(design, h, top)
    a, s, h = flank.T
    wall, wall_spread = _robust(np.column_stack([a**0, h, s, s**2]), a, flank)
    place = _meet(surface, wall, rim)
    step = 1e-5
    columns = [(_meet(surface + step * d, wall, rim) - place) / step for d in np.eye(6)]
    columns += [(_meet(surface, wall + step * d, rim) - place) / step for d in np.eye(4)]
    J = np.column_stack(columns)
    spread = np.zeros((10, 10))
    spread[:6, :6], spread[6:, 6:] = surface_spread, wall_spread
    return SeamEdge(float(place[0]), float(place[1]), J @ spread @ J.T)


def _meet(surface: Array, wall: Array, rim: float) -> Array:
    """(across, height) where both hold at the station itself (along = 0)."""
    a = rim
    for _ in range(50):
        h = surface[0] + surface[1] * (a - rim) + surface[3] * (a - rim) ** 2
        a = wall[0] + wall[1] * h
    return np.array([a, h])


def _robust(design: Array, values: Array, points: Array) -> tuple[Array, Array]:
    """Coefficients and covariance of a linear fit with Tukey weights, 20 rounds.

    What a facet or a bend leaves is shared by neighbours, so the covariance counts cubes of points (N, 3) and not
    points as independent (cluster-robust sandwich, Liang & Zeger 1986).
    """
    weight = np.ones(len(values))
    for _ in range(20):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)[0]
        residual = values - design @ found
        scale = max(MAD * float(np.median(np.abs(residual))), 1e-9)
        weight = biweight(residual / (TUKEY * scale))
    inverse = np.linalg.inv(np.einsum("ni,n,nj->ij", design, biweight_slope(residual / (TUKEY * scale)), design))
    _, cube = np.unique(np.floor(points / _CUBE).astype(int), axis=0, return_inverse=True)
    scores = np.zeros((cube.max() + 1, design.shape[1]))
    np.add.at(scores, cube.ravel(), design * (weight * residual)[:, None])
    cubes, unknowns = scores.shape
    few = cubes / max(cubes - unknowns, 1)
    return np.asarray(found), np.asarray(few * inverse @ scores.T @ scores @ inverse)
