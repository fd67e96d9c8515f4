"""Least squares over blocks: estimates, their covariance, and the same without some views."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.frames import Array, Indices
from stitch.statistics.jackknife import grouped_inflation


@dataclass(frozen=True)
class BlockLeastSquares:
    """z = X·x + noise in B blocks of m, with a weak prior; the noise's covariance is known.

    Rows weigh by their own variances (working independence, Liang & Zeger 1986): as long as effects are missing
    the scatter of the views is not the noise it is taken for, and full weights would trade millimetres at the
    targets for combinations that only look exact. The covariance of the estimates counts all correlations.
    """

    z: Array  # (B, m)
    X: Array  # (B, m, k)
    covariance: Array  # (B, m, m)
    precision: Array  # (k,) of the prior
    prior_vector: Array  # (k,) precision times the prior's middle

    @cached_property
    def scale(self) -> Array:
        """(k,) equilibrates: parameters count in rad, mm and per hour."""
        return np.asarray(1 / np.sqrt(np.maximum(np.diag(self.information) + self.precision, 1e-300)))

    @cached_property
    def weighted(self) -> Array:
        """(B, m, k) W·X."""
        return np.asarray(self.X / np.einsum("bii->bi", self.covariance)[..., None])

    @cached_property
    def information(self) -> Array:
        """(k, k) XᵀWX."""
        return _product(self.weighted, self.X)

    @cached_property
    def vector(self) -> Array:
        """(k,) XᵀWz."""
        return _product(self.weighted, self.z[..., None])[:, 0]

    def residual_vectors(self, estimates: Array) -> Array:
        """(B, k) XᵀW(z − X·x) of every block."""
        return np.asarray(np.einsum("bmk,bm->bk", self.weighted, self.z - self.X @ estimates))

    def solve(self, left_out: Array | Indices | None = None) -> Array:
        """(k,) estimates, without some blocks."""
        M, b = self.information, self.vector
        if left_out is not None:
            out = np.asarray(left_out, np.int64)
            M = M - _product(self.weighted[out], self.X[out])
            b = b - _product(self.weighted[out], self.z[out][..., None])[:, 0]
        inverse = _inverse(M + np.diag(self.precision), self.scale)
        return np.asarray(inverse @ (b + self.prior_vector))

    def estimates_covariance(self) -> Array:
        """(k, k) of the estimates under the blocks' full covariance."""
        spread = np.einsum("bmk,bmn,bnl->kl", self.weighted, self.covariance, self.weighted, optimize=True)
        inverse = _inverse(self.information + np.diag(self.precision), self.scale)
        return np.asarray(inverse @ (spread + np.diag(self.precision)) @ inverse)

    def shift_by_errors(self, errors: Array) -> Array:
        """(k, q) how far errors (B, m, q) of the blocks, which nobody models, move the estimates."""
        pulls = np.einsum("bmk,bmq->kq", self.weighted, errors)
        return np.asarray(_inverse(self.information + np.diag(self.precision), self.scale) @ pulls)

    def inflation(self, groups: Sequence[Indices], covariance: Array) -> float:
        """How much more leaving out groups of views moves the estimates than `covariance` says, at least 1."""
        return grouped_inflation(np.array([self.solve(group) for group in groups]), covariance)


def _product(X: Array, Y: Array) -> Array:
    """(k, l) Σ_b XᵀY of (B, m, k) and (B, m, l)."""
    return np.asarray(X.reshape(-1, X.shape[2]).T @ Y.reshape(-1, Y.shape[2]))


def _inverse(M: Array, scale: Array) -> Array:
    return np.asarray(np.linalg.pinv(M * np.outer(scale, scale), rcond=1e-14, hermitian=True) * np.outer(scale, scale))
