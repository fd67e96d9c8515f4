"""Smooth errors that every view has for itself: what the overlaps show of them, beside those that all views share.

A part that bends, a scanner that warms up or is read line by line while the arm still moves: each scan is sound, and no
motion of the views makes them meet.
"""

import numpy as np

from stitch.frames import Array, Indices, Mask
from stitch.observations.surfaces.free_poses import UnconstrainedPoses, solve_view_sums, visible_step
from stitch.observations.surfaces.point_gram import PointGram
from stitch.observations.surfaces.shown_errors import SmoothErrorLikelihood
from stitch.observations.surfaces.smooth_errors import COARSE

# Normals are off by up to a tenth of a radian: what moves points less than that along them, squared, is their noise.
_NORMAL_NOISE = 0.01
# Of many views those that follow each other have errors in common: so many parts of a session at most.
_MAX_PARTS = 30

# The causes of `by_view`: over the field the same in every view, over incidence, over the field view by view.
SHARED, INCIDENCE, PER_VIEW = range(3)


def view_error_likelihood(
    sums: PointGram, unconstrained: UnconstrainedPoses, noise: float, nuisance: int = 0
) -> SmoothErrorLikelihood:
    """Of sums over smooth errors for either view of a pair its own, those that all share, and what is beside them.

    Args:
        sums: of `smooth_sums`, apart.
    """
    g, part = unconstrained.overlaps.gram, part_of_view(unconstrained.overlaps.gram.views)
    at = _column_parameters(g.pairs, part, columns=sums.residual.shape[1])
    width = int(at.max()) + 1
    square, pull = np.zeros((width, width)), np.zeros(width)
    np.add.at(square, (at[:, :, None], at[:, None, :]), sums.square)
    np.add.at(pull, at, sums.residual)
    push = [_sum_on_views(sums, g.views, g.pairs, at, keep, width) for keep in (~g.labelled, g.labelled)]
    both = push[0] + push[1]
    square -= both.T @ solve_view_sums(g, *push)
    # The iteration ended a small step short of where the views agree best.
    pull += both.T @ visible_step(g).ravel()
    causes = _cause_columns(int(part[-1]) + 1, width - nuisance)
    return SmoothErrorLikelihood.from_normal_equations(
        square, pull, causes, g, noise, nuisance, threshold=_NORMAL_NOISE
    )


def part_of_view(views: int) -> Indices:
    """(V,) the part of the session to which a view belongs."""
    return np.arange(views) * min(views, _MAX_PARTS) // views


def _column_parameters(pairs: Array, part: Indices, columns: int) -> Indices:
    """(P, columns) the parameter that each column of a pair is: those of every part, then those that all share."""
    own = [COARSE * part[view][:, None] + np.arange(COARSE) for view in pairs.astype(np.int64).T]
    shared = COARSE * (part[-1] + 1) + np.arange(columns - 2 * COARSE)
    return np.hstack([*own, np.broadcast_to(shared, (len(pairs), len(shared)))])


def _sum_on_views(sums: PointGram, views: int, pairs: Array, at: Indices, keep: Mask, width: int) -> Array:
    """(6V, W) Σ w Bᵀg of some pairs on their views."""
    out = np.zeros((views, width, 6))
    v, w = pairs[keep].astype(np.int64).T
    vectors = np.moveaxis(sums.vector[keep], 1, 2)
    np.add.at(out, (v[:, None], at[keep]), vectors)
    np.subtract.at(out, (w[:, None], at[keep]), vectors)
    return np.moveaxis(out, 1, 2).reshape(6 * views, width)


def _cause_columns(parts: int, width: int) -> tuple[Array, Array, Array]:
    """SAME, INCIDENCE and CHANGING in the parameters, (width, ·) each."""
    every = np.eye(width)
    own, incidence, shared = np.split(every, [COARSE * parts, COARSE * parts + 1], axis=1)
    return np.hstack([own @ np.tile(np.eye(COARSE), (parts, 1)), shared]), incidence, own
