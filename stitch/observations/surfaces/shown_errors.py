"""How large smooth errors are that the overlaps show: variance components by likelihood, one for each cause."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from stitch.frames import Array
from stitch.observations.surfaces.gram import Gram

# What every scanner has, as a share of its noise along the ray, and the spread of its logarithm; what is asked at all.
USUAL_SHARE, _SHARE_SPREAD, SHARE_BOUNDS = 0.3, 0.7, (0.01, 10.0)
# Neighbouring distances share points and normals: so many times the variance of independent ones.
_CORRELATION_FACTOR = 3.0
# Combinations that the overlaps show less than this share of the clearest are rounding.
_ROUNDING_SHARE = 1e-6


@dataclass(frozen=True)
class SmoothErrorLikelihood:
    """What smooth errors of C causes leave within the overlaps, beside free poses, and how likely each size is.

    Errors f of variances S change the normal equations there by M f: Mf + noise is N(0, M S M + cσ²M). The causes
    need not be equally large.
    """

    data: Array  # (n,) in the directions that the overlaps show
    design: tuple[Array, ...]  # (n, K_c) per cause, for errors as large as the noise
    scatter: Array  # (n,) variances of `seen` without errors

    @classmethod
    def from_normal_equations(
        cls,
        M: Array,
        vector: Array,
        causes: Sequence[Array],
        g: Gram,
        noise: float,
        nuisance: int = 0,
        threshold: float = _ROUNDING_SHARE,
    ) -> "SmoothErrorLikelihood":
        """Of normal equations (K, K) and (K,), less what moving the views takes away.

        Args:
            causes: (K − beside, K_c) the errors of each cause, of unit size, in those parameters.
            nuisance: so many of the last parameters may have any size.
            threshold: combinations that the overlaps show less than this share of the clearest count as not seen.
        """
        M = (M + M.T) / 2
        if nuisance:
            # The Schur complement: what no size of those explains.
            K = len(M) - nuisance
            taken = M[:K, K:] @ np.linalg.pinv(M[K:, K:], rcond=_ROUNDING_SHARE, hermitian=True)
            M, vector = M[:K, :K] - taken @ M[K:, :K], vector[:K] - taken @ vector[K:]
        values, vectors = np.linalg.eigh(M)
        keep = values > threshold * values[-1]
        values, vectors = values[keep], vectors[:, keep]
        moved = noise * values[:, None] * vectors.T
        return cls(
            vectors.T @ vector, tuple(moved @ cause for cause in causes), _CORRELATION_FACTOR * g.variance * values
        )

    @property
    def map_shares(self) -> Array:
        """(C,) likeliest rms of the errors over the noise, with a prior of usual sizes."""

        def deviance(log_shares: Array) -> tuple[float, Array]:
            prior = (log_shares - np.log(USUAL_SHARE)) / _SHARE_SPREAD
            value, slope = self._deviance(log_shares)
            return value + float(prior @ prior), slope + 2 * prior / _SHARE_SPREAD

        start = np.full(len(self.design), np.log(USUAL_SHARE))
        bounds = [tuple(np.log(SHARE_BOUNDS))] * len(start)
        return np.asarray(np.exp(minimize(deviance, start, jac=True, method="L-BFGS-B", bounds=bounds).x))

    def ml_shares(self, most: Sequence[float]) -> tuple[Array, float]:
        """Shares (C,) without a prior, at most so large, and −2 log likelihood."""
        bounds = [(np.log(SHARE_BOUNDS[0]), np.log(size)) for size in most]
        # The likelihood is flat where errors are small: from the largest on, and from usual ones.
        largest = np.array([b for _, b in bounds])
        starts = [largest, np.minimum(largest, np.log(USUAL_SHARE))]
        fits = [minimize(self._deviance, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
        best = min(fits, key=lambda fit: float(fit.fun))
        return np.exp(best.x), float(best.fun)

    def estimate(self, cause: int, shares: Array) -> Array:
        """(K_c,) the likeliest errors of one cause in units of its size, where all causes have shares (C,)."""
        return np.asarray(
            shares[cause] * self.design[cause].T @ np.linalg.solve(self._data_covariance(shares), self.data)
        )

    def posterior_covariance(self, cause: int, shares: Array) -> Array:
        """(K_c, K_c) covariance of the errors of one cause about their estimate, in units of its size: one where the
        overlaps tell nothing of them.
        """
        told = shares[cause] * self.design[cause]
        return np.asarray(np.eye(told.shape[1]) - told.T @ np.linalg.solve(self._data_covariance(shares), told))

    def _data_covariance(self, shares: Array) -> Array:
        """(n, n) variance of `seen` where all causes have shares (C,)."""
        parts = [share**2 * t @ t.T for share, t in zip(shares, self.design, strict=True)]
        return np.asarray(sum(parts, np.diag(self.scatter)))

    def _deviance(self, log_shares: Array) -> tuple[float, Array]:
        """−2 log likelihood and its slopes (C,)."""
        parts = [np.exp(2 * log_share) * t @ t.T for log_share, t in zip(log_shares, self.design, strict=True)]
        spread = sum(parts, np.diag(self.scatter))
        inverse = np.linalg.inv(spread)
        weighed = inverse @ self.data
        slopes = [2 * (np.sum(inverse * part) - weighed @ part @ weighed) for part in parts]
        return float(np.linalg.slogdet(spread)[1] + self.data @ weighed), np.array(slopes)
