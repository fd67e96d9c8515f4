"""Hand-eye as a homography between the work plane (x, y of the flange frame at height h) and the image."""

import numpy as np
from scipy.optimize import least_squares

from stitch.errors import NoResultError
from stitch.frames import Array


def fit_homography(xy: Array, uv: Array) -> Array:
    """H (3, 3) with s·[u v 1]ᵀ = H·[x y 1]ᵀ, from N ≥ 4 points (N, 2) each; source, formula 5.

    Normalised DLT (Hartley 1997), then least squares of the image distances in pixels.

    Raises:
        NoResultError: fewer than four points, or points on a line.
    """
    xy, uv = np.asarray(xy, float), np.asarray(uv, float)
    if len(xy) < 4:
        raise NoResultError(
            f"a homography needs four or more holes, {len(xy)} are given; find more of them in the image"
        )
    to_xy, to_uv = normaliser(xy), normaliser(uv)
    p, q = _apply_homography(to_xy, xy), _apply_homography(to_uv, uv)
    one, zero = np.ones(len(p)), np.zeros((len(p), 3))
    row = np.column_stack([p, one])
    matrix = np.vstack([np.hstack([row, zero, -q[:, :1] * row]), np.hstack([zero, row, -q[:, 1:] * row])])
    values, vectors = np.linalg.svd(matrix)[1:]
    if values[7] < 1e-9 * values[0]:
        raise NoResultError("the holes lie on a line and fix no homography; use holes spread over the plane")
    h = vectors[8]
    # In normalised coordinates the plane's centre maps near the image's, so the last entry is far from zero.
    start = h[:8] / h[8]

    def matrix_of(x: Array) -> Array:
        return np.asarray(np.append(x, 1.0).reshape(3, 3))

    refined = least_squares(lambda x: (_apply_homography(matrix_of(x), p) - q).ravel(), start, method="lm").x
    H = np.linalg.inv(to_uv) @ matrix_of(refined) @ to_xy
    return np.asarray(H / H[2, 2])


def to_plane(H: Array, uv: Array) -> Array:
    """Work-plane points (..., N, 2) of image points in pixels; source, formula 13."""
    return _apply_homography(np.asarray(np.linalg.inv(H), float), np.asarray(uv, float))


def leave_one_out(xy: Array, uv: Array) -> Array:
    """Errors (N, 2) in the work plane: each hole mapped by the homography of the others, minus its true place."""
    xy, uv = np.asarray(xy, float), np.asarray(uv, float)
    errors = np.zeros_like(xy)
    for i in range(len(xy)):
        keep = np.arange(len(xy)) != i
        errors[i] = to_plane(fit_homography(xy[keep], uv[keep]), uv[i : i + 1])[0] - xy[i]
    return errors


def normaliser(points: Array) -> Array:
    """Similarity (d+1, d+1) that brings points (N, d) to mean 0 and mean distance √d (Hartley 1997)."""
    mean, size = points.mean(axis=0), points.shape[1]
    scale = np.sqrt(size) / max(float(np.linalg.norm(points - mean, axis=1).mean()), np.finfo(float).tiny)
    matrix = np.diag([scale] * size + [1.0])
    matrix[:size, size] = -scale * mean
    return matrix


def _apply_homography(H: Array, points: Array) -> Array:
    mapped = points @ H[:, :2].T + H[:, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])
