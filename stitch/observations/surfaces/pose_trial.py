"""A model of the views' twists tried on sums over pairs: no new matches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stitch.frames import Array, Indices
from stitch.observations.surfaces.gram import column_space, fit_columns, pair_squares
from stitch.observations.surfaces.point_effects import PointGram

if TYPE_CHECKING:
    from stitch.observations.surfaces.pose_evidence import PoseEvidence


@dataclass(frozen=True)
class PoseTrial:
    """Columns X (6V, k) of twists; `points` are the sums of the last ones if these change the points themselves."""

    evidence: PoseEvidence
    X: Array
    points: PointGram | None
    precision: Array | None = None  # (k,) of a prior around zero

    def solve(self, left_out: Indices | None) -> Array:
        """Coefficients (k,) by generalised least squares without some views."""
        e = self.evidence
        white, z = e.white_reduction @ self.X, e.raw_white_z
        if self.precision is not None:
            white, z = np.vstack([white, np.diag(np.sqrt(self.precision))]), np.append(z, np.zeros(self.X.shape[1]))
        if left_out is not None:
            # A view is left out by letting it move freely: six more columns each.
            free = e.white_reduction[:, _columns_of(left_out)]
            white = np.hstack([white, np.vstack([free, np.zeros((len(z) - len(free), free.shape[1]))])])
        return fit_columns(white, z)[: self.X.shape[1]]

    def squares(self, coefficients: Array) -> Array:
        """Σ w e² per pair after the model moved; point effects change e itself and do not move the views."""
        g, points = self.evidence.freed.overlaps.gram, self.points
        if points is None:
            return pair_squares(g, self._moved(self.X, coefficients))
        k = points.residual.shape[1]
        theta, rest = coefficients[-k:], coefficients[:-k]
        moved = self._moved(self.X[:, :-k], rest)
        difference = moved[g.pairs[:, 0]] - moved[g.pairs[:, 1]]
        cross = np.einsum("pi,pik,k->p", difference, points.vector, theta)
        return np.asarray(
            pair_squares(g, moved) + 2 * points.residual @ theta + 2 * cross
            + np.einsum("k,pkl,l->p", theta, points.square, theta)
        )  # fmt: skip

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """In the directions of the whitened channel that the left-out views alone move."""
        e = self.evidence
        own = column_space(e.white_reduction[:, _columns_of(left_out)])
        return float(np.sum((own.T @ (e.raw_white_z - e.white_reduction @ (self.X @ coefficients))) ** 2))

    def influential_views(self, coefficients: Array) -> Indices:
        """All views."""
        return np.arange(self.evidence.freed.overlaps.gram.views, dtype=np.int64)

    def _moved(self, X: Array, coefficients: Array) -> Array:
        return np.asarray((X @ coefficients).reshape(-1, 6) - self.evidence.freed.twists)


def _columns_of(views: Indices) -> Array:
    return np.asarray((6 * np.asarray(views)[:, None] + np.arange(6)).ravel())
