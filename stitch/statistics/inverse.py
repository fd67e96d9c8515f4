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
        try:
            L = np.linalg.cholesky(V)
        except np.linalg.LinAlgError:
            return V, np.inf
        return np.asarray(np.linalg.inv(V), float), 2 * float(np.log(np.einsum("bii->bi", L)).sum())
    # One large block: from its Cholesky factor, at half the cost.
    half, failed = dpotrf(V[0], lower=1)
    if failed:
        return V, np.inf
    lower, _ = dpotri(half, lower=1)
    inverse = np.tril(lower) + np.tril(lower, -1).T
    return inverse[None], 2 * float(np.log(np.diag(half)).sum())
