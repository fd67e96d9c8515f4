"""Least squares in unknowns of mixed units: columns are equilibrated first, what says nothing drops out."""

import numpy as np

from stitch.frames import Array


def column_space(columns: Array, relative: float = 1e-9) -> Array:
    """(n, r) orthonormal basis of the columns (n, K), whatever their units; combinations that say nothing drop out."""
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    U, s, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(U[:, s > relative * s[0]])


def fit_columns(columns: Array, values: Array) -> Array:
    """(K,) least squares of columns (n, K), whatever their units, to values (n,)."""
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(columns / scale, values, rcond=1e-10)[0] / scale)


def least_squares(matrix: Array, vector: Array, relative: float = 1e-10) -> Array:
    """Minimum-norm solution of the symmetric system matrix·x = −vector, in scaled unknowns."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * scale[:, None] * scale[None, :])
    keep = values > relative * values[-1]
    projected = vectors[:, keep].T @ (-vector * scale) / values[keep]
    return np.asarray(scale * (vectors[:, keep] @ projected))
