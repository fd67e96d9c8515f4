"""Which of many possible views bring most: information about hand-eye and effects, view by view.

Every view says its twist against the part, but for a motion that all of them share, with the scanner's noise; poses
err as expected, together. A normal matrix of the views chosen so far answers every question; what one more view would
add to it is a Schur complement, for all that could be next at once (Fedorov 1972; Atkinson, Donev & Tobias 2007,
ch. 12).

`LinearModel` does not serve here: its numbers are the visible directions of all views together, and no view, chosen or
left out, has rows of its own among them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from stitch.numerics.frames import Array
from stitch.numerics.least_squares import equilibrated

# Precision of ten plausible sizes: a rival may take each of its parameters that large.
RIDGE = 0.01
# A direction that a view sees less than this share of its clearest one is as good as unseen.
_UNSEEN = 1e-6


@dataclass(frozen=True)
class TwistChannel:
    """Twists of N views that could be taken: their covariance, and columns of what is asked and what is in the way."""

    covariance: Array  # (6N, 6N) of pose errors and noise
    columns: Array  # (6N, q)

    def normal(self, chosen: Sequence[int]) -> Array:
        """(q, q) normal matrix of some views."""
        white = self._white(chosen)[1]
        return white.T @ white

    def with_each(self, chosen: Sequence[int], others: Sequence[int]) -> Array:
        """(K, q, q) normal matrices of some views and one more."""
        half, white = self._white(chosen)
        rows = _rows(chosen)
        more = _rows(others)
        B = solve_triangular(half, self.covariance[np.ix_(rows, more)], lower=True).reshape(len(rows), -1, 6)
        alone = self.covariance.reshape(len(self.covariance) // 6, 6, -1, 6)[others, :, others]
        left = alone - np.einsum("rki,rkj->kij", B, B)
        columns = self.columns[more].reshape(len(others), 6, -1) - np.einsum("rki,rq->kiq", B, white)
        fresh = np.linalg.solve(np.linalg.cholesky(left), columns)
        return white.T @ white + fresh.transpose(0, 2, 1) @ fresh

    def _white(self, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Cholesky factor of the chosen rows' covariance, and their columns in units of it."""
        rows = _rows(chosen)
        half = np.linalg.cholesky(self.covariance[np.ix_(rows, rows)])
        return half, np.asarray(solve_triangular(half, self.columns[rows], lower=True))


def _rows(views: Sequence[int]) -> Array:
    return np.asarray((6 * np.asarray(views)[:, None] + np.arange(6)).ravel())


def noise_of(information: Array, variance: float, lever: float) -> Array:
    """(6N, 6N) noise of the twists of N views from their normal matrices; what they do not see is as good as unknown.

    Args:
        information: (N, 6, 6) Σ w BᵀB of each view's correspondences.
        variance: of a correspondence.
        lever: by which a radian counts as a length.
    """
    scale = np.array([1 / lever] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    known = np.maximum(values, _UNSEEN * values[:, -1:])
    half = scale[:, None] * vectors * np.sqrt(variance / known)[:, None]
    out = np.zeros((len(values), 6, len(values), 6))
    each = np.arange(len(values))
    out[each, :, each] = half @ half.transpose(0, 2, 1)
    return out.reshape(6 * len(values), -1)


def separations(normal: Array, own: slice, rival: slice) -> Array:
    """Return (..., p) squared length of what every column of a pattern keeps when a rival's imitate it, all else being
    free.

    Args:
        normal: (..., q, q) normal matrix; columns at plausible sizes.
        own: of the pattern.
        rival: of the rival.
    """
    q = normal.shape[-1]
    rest = np.setdiff1d(np.arange(q), np.arange(own.start, own.stop))
    ridge = np.where((rest >= rival.start) & (rest < rival.stop), RIDGE, 0.0)
    free = normal[..., rest[:, None], rest] + np.diag(ridge)
    across = normal[..., rest[:, None], np.arange(own.start, own.stop)]
    same_units, unit = equilibrated(free)
    inverse = np.linalg.pinv(same_units, rcond=1e-12, hermitian=True)
    scaled = across * unit[..., :, None]
    imitated = np.einsum("...ap,...ab,...bp->...p", scaled, inverse, scaled)
    left = np.diagonal(normal[..., own, own], axis1=-2, axis2=-1) - imitated
    return np.maximum(left, 0.0)
