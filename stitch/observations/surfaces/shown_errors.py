"""How large smooth errors of the scanner are that the overlaps show."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from stitch.frames import Array, Indices
from stitch.observations.surfaces.gram import Gram
from stitch.observations.surfaces.point_gram import PointGram

# What every scanner has, as a share of its noise along the ray, and the spread of its logarithm; what is asked at all.
USUAL_SHARE, _SPREAD, SHARES = 0.3, 0.7, (0.01, 10.0)
# Neighbouring distances share points and normals: so many times the variance of independent ones.
_CORRELATION = 3.0
# Combinations that the overlaps show less than this share of the clearest tell nothing.
_TOLD = 1e-6


@dataclass(frozen=True)
class ShownErrors:
    """What smooth errors leave within the overlaps, beside free poses, and how likely that is for errors of some size.

    Errors f of variances S change the normal equations there by M f: Mf + noise is N(0, M S M + cσ²M). The field
    and the incidence are two causes, and need not be equally large.
    """

    seen: Array  # (n,) in the directions that the overlaps show
    told: Array  # (n, K) for errors as large as the noise
    scatter: Array  # (n,) variances of `seen` without errors

    @classmethod
    def of(cls, sums: PointGram, twists: Array, g: Gram, noise: float, beside: int = 0) -> "ShownErrors":
        """Beside the last so many parameters of the sums, which may have any size; twists (6V, K) of their views."""
        own = twists.reshape(g.views, 6, -1)
        # What the poses do not follow: Σ g² less what moving the views takes away.
        followed = np.einsum("pik,pil->kl", sums.vector, own[g.pairs[:, 0]] - own[g.pairs[:, 1]])
        M, pull = sums.square.sum(axis=0) - (followed + followed.T) / 2, sums.residual.sum(axis=0)
        if beside:
            # The Schur complement: what no size of those explains.
            K = len(M) - beside
            taken = M[:K, K:] @ np.linalg.pinv(M[K:, K:], rcond=_TOLD, hermitian=True)
            M, pull = M[:K, :K] - taken @ M[K:, :K], pull[:K] - taken @ pull[K:]
        values, vectors = np.linalg.eigh(M)
        keep = values > _TOLD * values[-1]
        values, vectors = values[keep], vectors[:, keep]
        return cls(vectors.T @ pull, noise * values[:, None] * vectors.T, _CORRELATION * g.variance * values)

    @property
    def shares(self) -> Array:
        """(K,) likeliest rms of the errors over the noise, with a prior of usual sizes."""

        def deviance(log_shares: Array) -> float:
            prior = (log_shares - np.log(USUAL_SHARE)) / _SPREAD
            return self._deviance(log_shares) + float(prior @ prior)

        bounds = [tuple(np.log(SHARES))] * 2
        found = minimize(deviance, np.full(2, np.log(USUAL_SHARE)), method="L-BFGS-B", bounds=bounds)
        return np.asarray(np.exp(found.x)[self._cause])

    def likeliest(self, most: float) -> tuple[Array, float]:
        """Shares (2,) of field and incidence without a prior, the field's at most so large; and −2 log likelihood."""
        bounds = [np.log([SHARES[0], most]), np.log(SHARES)]
        # The likelihood is flat where errors are small: from the largest on.
        starts = [np.array([bounds[0][1], b]) for b in np.log([USUAL_SHARE, SHARES[1]])]
        fits = [minimize(self._deviance, start, method="L-BFGS-B", bounds=bounds) for start in starts]
        best = min(fits, key=lambda fit: float(fit.fun))
        return np.exp(best.x), float(best.fun)

    @property
    def _cause(self) -> Indices:
        """(K,) 0 for the field, 1 for incidence, which is the last."""
        return np.append(np.zeros(self.told.shape[1] - 1, np.int64), 1)

    def _deviance(self, log_shares: Array) -> float:
        spread = (self.told * np.exp(2 * log_shares)[self._cause]) @ self.told.T + np.diag(self.scatter)
        return float(np.linalg.slogdet(spread)[1] + self.seen @ np.linalg.solve(spread, self.seen))
