"""A covariance in blocks: its inverse, its factor and its determinant."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dlauum, dpotrf, dtrtri

from stitch.frames import Array


@dataclass(frozen=True)
class InverseCovariance:
    """Of a covariance V in B blocks of m."""

    matrix: Array  # (B, m, m) V⁻¹
    half: Array  # (B, m, m) L⁻¹, lower, with V = L Lᵀ
    logdet: float  # of V; infinite where it has no inverse


def invert_covariance(V: Array) -> InverseCovariance:
    """The inverse of (B, m, m); of a matrix that has none `logdet` is infinite."""
    # A search or a leap that ran away ends among infinite variances.
    if not np.isfinite(V).all():
        return InverseCovariance(V, V, np.inf)
    return _invert_blocks(V) if len(V) > 1 else _invert_single(V[0])


def _invert_single(V: Array) -> InverseCovariance:
    """Of one large block."""
    L, failed = dpotrf(V, lower=1, clean=1)
    if failed:
        return InverseCovariance(V[None], V[None], np.inf)
    half, _ = dtrtri(L, lower=1)
    lower, _ = dlauum(half, lower=1)
    inverse = np.tril(lower) + np.tril(lower, -1).T
    return InverseCovariance(inverse[None], half[None], 2 * float(np.log(np.diag(L)).sum()))


def _invert_blocks(V: Array) -> InverseCovariance:
    """Of many small blocks, by Cholesky factors of all at once: a library's loop over them takes five times as long."""
    m = V.shape[1]
    A = np.ascontiguousarray(V.transpose(1, 2, 0))
    L, half = np.zeros_like(A), np.zeros_like(A)  # blocks last
    for j in range(m):
        below = A[j:, j] - np.einsum("ikb,kb->ib", L[j:, :j], L[j, :j])
        if not (below[0] > 0).all():
            return InverseCovariance(V, V, np.inf)
        L[j:, j] = below / np.sqrt(below[0])
        half[j, :j] = -np.einsum("kb,kib->ib", L[j, :j], half[:j, :j]) / L[j, j]
        half[j, j] = 1 / L[j, j]
    half = np.ascontiguousarray(half.transpose(2, 0, 1))
    return InverseCovariance(half.transpose(0, 2, 1) @ half, half, 2 * float(np.log(np.einsum("iib->ib", L)).sum()))
