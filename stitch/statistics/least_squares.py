"""Least squares in unknowns of mixed units: columns are equilibrated first, what says nothing drops out."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from stitch.frames import Array


@dataclass(frozen=True)
class GeneralisedFit:
    """Generalised least squares with a prior: what was seen (n,) to a unknowns."""

    gain: Array  # (a, n)
    covariance: Array  # (a, a)

    def solve(self, z: Array, prior_vector: Array) -> Array:
        """(a,) from what was seen (n,), and the prior's precision times its middle (a,)."""
        return np.asarray(self.gain @ z + self.covariance @ prior_vector)


def generalised_fit(noise: Array, columns: Array, precision: Array) -> GeneralisedFit:
    """Columns (n, a) under noise of covariance (n, n), with a prior of a precision (a, a); units may be mixed."""
    weighted = cho_solve(cho_factor(noise, lower=True), columns)
    M = columns.T @ weighted + precision
    scale = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    covariance = np.linalg.inv(M * np.outer(scale, scale)) * np.outer(scale, scale)
    return GeneralisedFit(np.asarray(covariance @ weighted.T), np.asarray(covariance))


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


def summed_squares(blocks: Array) -> Array:
    """(n, n) Σ_v B_v B_vᵀ of blocks (V, n, k): covariance of n numbers that V independent unit errors move.

    One matrix product: with hundreds of views a sum over three indices takes a hundred times as long.
    """
    wide = blocks.transpose(1, 0, 2).reshape(blocks.shape[1], -1)
    return np.asarray(wide @ wide.T)
