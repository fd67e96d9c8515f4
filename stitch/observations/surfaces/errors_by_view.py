"""Smooth errors that every view has for itself: what the overlaps show of them, beside those that all views share.

A part that bends, a scanner that warms up or is read line by line while the arm still moves: each scan is sound, and no
motion of the views makes them meet.
"""

from collections.abc import Iterator

import numpy as np

from stitch.frames import Array, Indices, Mask
from stitch.observations.surfaces.free_poses import FreePoses, answer_of_views
from stitch.observations.surfaces.point_gram import PointGram
from stitch.observations.surfaces.shown_errors import ShownErrors
from stitch.observations.surfaces.smooth_errors import DEGREE, FINER, orders, size_of_orders

# Normals are off by up to a tenth of a radian: what moves points less than that along them, squared, is their noise.
_TOLD = 0.01
# Of many views those that follow each other have errors in common: so many parts of a session at most.
_PARTS = 30

# The causes of `by_view`: over the field the same in every view, over incidence, over the field view by view.
SAME, INCIDENCE, CHANGING = range(3)


def by_view(sums: PointGram, freed: FreePoses, noise: float, beside: int = 0) -> ShownErrors:
    """Of sums over smooth errors and what is beside them, for either view of a pair its own (`smooth_errors.py`)."""
    g, part = freed.overlaps.gram, part_of_view(freed.overlaps.gram.views)
    at = _parameters(g.pairs, part, columns=sums.residual.shape[1] // 2)
    width = int(at.max()) + 1
    square, pull = np.zeros((width, width)), np.zeros(width)
    np.add.at(square, (at[:, :, None], at[:, None, :]), sums.square)
    np.add.at(pull, at, sums.residual)
    push = [_on_views(sums, g.views, g.pairs, at, keep, width) for keep in (~g.labelled, g.labelled)]
    square -= (push[0] + push[1]).T @ answer_of_views(g, *push)
    causes = tuple(_causes(int(part[-1]) + 1))
    return ShownErrors.of(square, pull, causes, g, noise, beside, told=_TOLD)


def part_of_view(views: int) -> Indices:
    """(V,) the part of the session to which a view belongs."""
    return np.arange(views) * min(views, _PARTS) // views


def _parameters(pairs: Array, part: Indices, columns: int) -> Indices:
    """(P, 2 · columns) the parameter that each column of a pair is: coarse errors part by part, the rest in common."""
    coarse = len(orders(DEGREE))
    common = coarse * (part[-1] + 1) + np.arange(columns - coarse)
    own = [coarse * part[view][:, None] + np.arange(coarse) for view in pairs.astype(np.int64).T]
    return np.hstack([np.hstack([each, np.broadcast_to(common, (len(pairs), len(common)))]) for each in own])


def _on_views(sums: PointGram, views: int, pairs: Array, at: Indices, keep: Mask, width: int) -> Array:
    """(6V, W) Σ w Bᵀg of some pairs on their views."""
    out = np.zeros((views, width, 6))
    v, w = pairs[keep].astype(np.int64).T
    vectors = np.moveaxis(sums.vector[keep], 1, 2)
    np.add.at(out, (v[:, None], at[keep]), vectors)
    np.subtract.at(out, (w[:, None], at[keep]), vectors)
    return np.moveaxis(out, 1, 2).reshape(6 * views, width)


def _causes(parts: int) -> Iterator[Array]:
    """SAME, INCIDENCE and CHANGING of unit rms, in the parameters but those beside them."""
    coarse, fine = len(orders(DEGREE)), len(orders(FINER))
    width = coarse * parts + fine - coarse + 1
    everything = np.eye(width)
    own, shared = everything[:, : coarse * parts], everything[:, coarse * parts : -1]
    same = np.hstack([own @ np.tile(np.eye(coarse), (parts, 1)), shared])
    yield same / np.linalg.norm(size_of_orders(FINER))
    yield everything[:, -1:]
    yield own
