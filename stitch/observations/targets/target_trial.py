"""A model of labelled points tried in the linear approximation."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.frames import Array, Indices
from stitch.observations.response import CoefficientPrior
from stitch.observations.targets.rows import TargetRows
from stitch.statistics.block_least_squares import BlockLeastSquares

# Views of largest influence on the estimates: if one alone carries them, it is among these.
_CARRIERS = 20


@dataclass(frozen=True)
class TargetTrial:
    """Columns X (B, m, k) of rows with the covariance of the null, fitted as a run fits them."""

    rows: TargetRows
    covariance: Array  # (B, m, m)
    X: Array
    prior: CoefficientPrior | None = None

    @cached_property
    def blocks(self) -> BlockLeastSquares:
        zero = np.zeros(self.X.shape[2])
        precision, middle = (zero, zero) if self.prior is None else (self.prior.precision, self.prior.mean)
        return BlockLeastSquares(-self.rows.residual, self.X, self.covariance, precision, precision * middle)

    def solve(self, left_out: Indices | None = None) -> Array:
        """Coefficients (k,) without some views."""
        return self.blocks.solve(left_out)

    def squares(self, coefficients: Array) -> Array:
        """(V,) squares of the 3D distances of a view's targets."""
        return np.asarray(np.nansum(self.rows.distances(self.rows.residual + self.X @ coefficients) ** 2, axis=1))

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """Of the distances at the left-out views' targets, in units of the sensor's noise: each is seen as it is."""
        own = self.rows.used[left_out, : self.rows.positions]
        rest = (self.rows.residual + self.X @ coefficients)[left_out, : self.rows.positions]
        return float(np.sum(rest[own] ** 2 / self.rows.noise[left_out, : self.rows.positions][own]))

    def influential_views(self, coefficients: Array) -> Indices:
        """(n,) the views without which the coefficients would move most, to first order."""
        b = self.blocks
        inverse = np.linalg.pinv(b.information * np.outer(b.scale, b.scale), rcond=1e-14, hermitian=True)
        moves = b.residual_vectors(coefficients) * b.scale @ inverse
        sizes = np.linalg.norm(moves[: len(self.rows.lever)], axis=1)
        return np.asarray(np.argsort(-sizes, kind="stable")[:_CARRIERS], np.int64)
