"""Circle (in a plane) or sphere (in space) through points with outliers: RANSAC, then a robust fit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from stitch.frames import Array, Indices

_TRIALS = 200
# Larger circles than this many sizes are of flat things beside the ball.
_LARGEST = 3.0
# Points for the search and the fit of one view; the joint fit sees all of them.
_POINTS = 3000
# Points this many robust sigmas off the fitted circle or sphere are of something else.
_OUTLIER_GATE = 6.0


@dataclass(frozen=True)
class Ball:
    """Circle (k = 2) or sphere (k = 3)."""

    centre: Array  # (k,)
    radius: float
    sigma: float  # robust sigma of the distances, length unit
    keep: NDArray[np.bool_]  # (N,) the points of the circle or sphere
    covariance: Array  # (k + 1, k + 1) of centre and radius, both free, from the points' sigma


def fit_ball(points: Array, size: float, known: bool = False) -> Ball:
    """Robust fit to points (N, k), k = 2 or 3.

    Other things may be in the scan: the search draws its points from neighbourhoods of the ball's size and
    counts those within 2 % of it; the fit minimises a soft L1 loss of the distances at the scale that they
    show themselves.

    Args:
        size: about the radius; with `known` exactly, and only the centre is sought.
    """
    centre, found = _ransac(points[:: max(1, len(points) // _POINTS)], size)
    return refine_ball(points, centre, found, size if known else None)


def refine_ball(points: Array, centre: Array, radius: float, known: float | None = None) -> Ball:
    """Robust fit to points (N, k) from a first centre (k,) and radius; others may be among them.

    Args:
        known: the radius, where only the centre is sought.
    """
    thin = points[:: max(1, len(points) // _POINTS)]
    x = centre if known is not None else np.append(centre, radius)
    inside, scale = _distances(np.append(centre, radius), thin, None), 0.02 * (known or radius)
    gate = scale
    for _ in range(4):
        kept = thin[np.abs(inside) < gate]
        if len(kept) <= len(x):
            break
        x = least_squares(_distances, x, args=(kept, known), loss="soft_l1", f_scale=scale, x_scale="jac").x
        scale = max(1.4826 * float(np.median(np.abs(_distances(x, kept, known)))), 1e-9 * scale)
        inside, gate = _distances(x, thin, known), _OUTLIER_GATE * scale
    off = _distances(x, points, known)
    k, keep, sigma = points.shape[1], np.abs(off) < gate, scale
    outward = points[keep] - x[:k]
    rows = np.column_stack([outward / np.linalg.norm(outward, axis=1, keepdims=True), np.ones(len(outward))])
    covariance = sigma**2 * np.linalg.pinv(rows.T @ rows)
    return Ball(x[:k], float(x[k] if known is None else known), sigma, keep, covariance)


def _distances(x: Array, points: Array, radius: float | None) -> Array:
    k = points.shape[1]
    return np.asarray(np.linalg.norm(points - x[:k], axis=1) - (x[k] if radius is None else radius))


def _ransac(points: Array, size: float) -> tuple[Array, float]:
    """Centre and radius with most points within the gate; spheres through k + 1 neighbouring points each."""
    rng = np.random.default_rng(0)
    k, middle = points.shape[1], points.mean(axis=0)
    local = points - middle
    draws = local[_neighbours(local, size, k + 1, rng)]
    # |p|² = 2 c·p + (r² − |c|²) for each of the k + 1 points.
    system = np.concatenate([2 * draws, np.ones((_TRIALS, k + 1, 1))], axis=2)
    good = np.abs(np.linalg.det(system)) > (1e-3 * size) ** k
    whole = np.hstack([2 * local, np.ones((len(local), 1))])
    candidates = [np.linalg.lstsq(whole, (local**2).sum(axis=1), rcond=None)[0]]
    candidates += list(np.linalg.solve(system[good], (draws[good] ** 2).sum(axis=2)[..., None])[..., 0])
    best, most = (local[0], size), -1
    for x in candidates:
        radius = float(np.sqrt(max(x[k] + x[:k] @ x[:k], 0.0)))
        count = int((np.abs(np.linalg.norm(local - x[:k], axis=1) - radius) < 0.02 * size).sum())
        if count > most and radius < _LARGEST * size:
            best, most = (x[:k], radius), count
    return best[0] + middle, best[1]


def _neighbours(points: Array, size: float, count: int, rng: np.random.Generator) -> Indices:
    """Indices (trials, count) of random points no further than `size` from a first one."""
    out = rng.integers(len(points), size=(_TRIALS, count))
    for trial in out:
        near = np.flatnonzero(((points - points[trial[0]]) ** 2).sum(axis=1) < size**2)
        trial[1:] = rng.choice(near, count - 1)
    return out
