"""A model of the views' twists tried on sums over pairs: no new matches."""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, Indices
from stitch.observations.linear_model import LinearModel
from stitch.observations.response import CoefficientPrior, PointSums
from stitch.observations.surfaces.free_poses import UnconstrainedPoses
from stitch.observations.surfaces.gram import pair_squares
from stitch.observations.surfaces.point_gram import PointGram
from stitch.statistics.least_squares import column_space, fit_columns


@dataclass(frozen=True)
class SurfaceTrial:
    """Columns X (6V, k) of twists; `points` are the sums of the last ones if these change the points themselves."""

    linear: LinearModel
    unconstrained: UnconstrainedPoses
    X: Array
    points: PointSums | None = None
    prior: CoefficientPrior | None = None

    def solve(self, left_out: Indices | None = None) -> Array:
        """Coefficients (k,) by generalised least squares without some views."""
        white, z = self._white(self.X), self.linear.white_z
        if self.prior is not None:
            half = np.sqrt(self.prior.precision)
            white, z = np.vstack([white, np.diag(half)]), np.append(z, half * self.prior.mean)
        if left_out is not None:
            # A view is left out by letting it move freely: six more columns each.
            free = self._white(self._twists_of(left_out))
            white = np.hstack([white, np.vstack([free, np.zeros((len(z) - len(free), free.shape[1]))])])
        return fit_columns(white, z)[: self.X.shape[1]]

    def squares(self, coefficients: Array) -> Array:
        """(pairs,) Σ w e² after the model moved; point effects change e itself and do not move the views."""
        g, points = self.unconstrained.overlaps.gram, self.points
        if not isinstance(points, PointGram):
            return pair_squares(g, self._moved(self.X, coefficients))
        k = points.residual.shape[1]
        theta, rest = coefficients[-k:], coefficients[:-k]
        moved = self._moved(self.X[:, :-k], rest)
        difference = moved[g.pairs[:, 0]] - moved[g.pairs[:, 1]]
        cross = np.einsum("pi,pik,k->p", difference, points.vector, theta)
        quadratic = np.einsum("k,pkl,l->p", theta, points.square, theta)
        return np.asarray(pair_squares(g, moved) + 2 * points.residual @ theta + 2 * cross + quadratic)

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """In the directions of the whitened channel that the left-out views alone move."""
        own = column_space(self._white(self._twists_of(left_out)))
        rest = self.linear.white_z - self._white((self.X @ coefficients)[:, None])[:, 0]
        return float(np.sum((own.T @ rest) ** 2))

    def influential_views(self, coefficients: Array) -> Indices:
        """(V,) all views."""
        return np.arange(self.unconstrained.overlaps.gram.views, dtype=np.int64)

    def _white(self, response: Array) -> Array:
        return self.linear.whiten(self.linear.reduce(response))

    def _twists_of(self, views: Indices) -> Array:
        """(6V, 6k) unit twists of some views."""
        return np.eye(len(self.X))[:, (6 * np.asarray(views)[:, None] + np.arange(6)).ravel()]

    def _moved(self, X: Array, coefficients: Array) -> Array:
        return np.asarray((X @ coefficients).reshape(-1, 6) - self.unconstrained.twists)
