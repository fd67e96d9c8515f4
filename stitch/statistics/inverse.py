"""The inverse of a covariance in blocks, with its determinant."""

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri

from stitch.frames import Array


def inverted(V: Array) -> tuple[Array, float]:
    """(B, m, m) inverse of a covariance, and log det; infinite where it has none."""
    # A search or a leap that ran away ends among infinite variances.
    if not np.isfinite(V).all():
        return V, np.inf
    if len(V) > 1:
        return _of_blocks(V)
    # One large block: from its Cholesky factor, at half the cost.
    half, failed = dpotrf(V[0], lower=1)
    if failed:
        return V, np.inf
    lower, _ = dpotri(half, lower=1)
    inverse = np.tril(lower) + np.tril(lower, -1).T
    return inverse[None], 2 * float(np.log(np.diag(half)).sum())


def _of_blocks(V: Array) -> tuple[Array, float]:
    """Of many small blocks, by Cholesky factors of all at once: a library's loop over them takes five times as long."""
    m = V.shape[1]
    A = np.ascontiguousarray(V.transpose(1, 2, 0))
    L, half = np.zeros_like(A), np.zeros_like(A)  # lower factors and their inverses, blocks last
    for j in range(m):
        below = A[j:, j] - np.einsum("ikb,kb->ib", L[j:, :j], L[j, :j])
        if not (below[0] > 0).all():
            return V, np.inf
        L[j:, j] = below / np.sqrt(below[0])
        half[j, :j] = -np.einsum("kb,kib->ib", L[j, :j], half[:j, :j]) / L[j, j]
        half[j, j] = 1 / L[j, j]
    half = np.ascontiguousarray(half.transpose(2, 0, 1))
    return np.asarray(half.transpose(0, 2, 1) @ half), 2 * float(np.log(np.einsum("iib->ib", L)).sum())
