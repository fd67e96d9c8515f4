"""Which views are asked for each other's surface: all that overlap, and of very many the best few dozen of each.

What a point says of its view's pose its own noise limits: found in a few other views it has said nearly all, while a
further point says as much again. So a view keeps the partners that show most of it, and some spread over the others,
which hold the views together over long ways; a pair that nothing stands in for, as a bridge between two groups of
views, stays whatever it shows. More points than of few views take turns among the partners: each is found some five
times.
"""

from collections.abc import Sequence

import numpy as np

from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.matching import (
    MINIMUM_OVERLAP,
    near_pairs,
    neighbour_queries,
    overlap_shares,
    overlapping_pairs,
    sample_points,
)
from stitch.session.scan import Scan

# Of up to so many views all that overlap are partners.
_ALL_PARTNERS = 40
# Of more a view keeps so many: those that show most of it, and some evenly over the rest in the order of what they
# show.
_BEST, _SPREAD = 12, 8
# Kept besides: pairs with so large a share of all that holds their two views together, directly and by way of others.
_IRREPLACEABLE = 0.25
# Points of a view that are probed there: which partners are best needs no more.
_PROBES = 50
# How often a point is found in its view's partners, on average, where they take turns; and by how much more points
# there are then. Noise of the points alone then moves the poses' variance to 0.82 (a blade, 60 views) and 1.04 (a
# table, 100 views) of what it is with all partners, 20 at a time; without more points to 1.08 and 1.33.
_FOUND, _MORE_POINTS = 5.5, 1.3


def find_partners(
    scans: Sequence[Scan], poses: Array, gate: float, at_most: int
) -> tuple[list[tuple[int, int]], Indices | None]:
    """Return the pairs of views (v < w) whose points are matched, and the stride t (V,) of each view.

    Every t-th point of a view is searched in each partner, the partners taking different points in turn. Of up to
    `_ALL_PARTNERS` views the pairs are all that overlap, and the strides None: `match_pairs` then chooses them.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
        gate: largest distance between corresponding points, length_unit.
        at_most: points of a view that are probed for overlap.
    """
    if len(scans) <= _ALL_PARTNERS:
        return overlapping_pairs(scans, poses, gate, at_most), None
    queries = neighbour_queries(scans, poses, [sample_points(scan, min(at_most, _PROBES)) for scan in scans])
    near = near_pairs(scans, poses, gate)
    shares = np.zeros((len(scans), len(scans)))
    for (v, w), share in overlap_shares(queries, [*near, *((w, v) for v, w in near)], gate).items():
        shares[v, w] = share
    meet = np.maximum(shares, shares.T) >= MINIMUM_OVERLAP
    kept = _best_of(shares + shares.T, meet)
    strides = np.maximum(np.round((shares * kept).sum(axis=1) / _FOUND), 1).astype(np.int64)
    return [(v, w) for v, w in near if kept[v, w]], strides


def more_points(scans: Sequence[Scan], samples: Sequence[Indices], strides: Indices) -> list[Indices]:
    """Return per view the numbers of the points to search: `_MORE_POINTS` times as many where the stride exceeds 1.

    Args:
        samples: per view the numbers of its points where every one is searched in every partner.
        strides: (V,) as `find_partners` returns them.
    """
    return [
        sample_points(scan, round(_MORE_POINTS * len(index))) if stride > 1 else index
        for scan, index, stride in zip(scans, samples, strides, strict=True)
    ]


def _best_of(shares: Array, meet: Mask) -> Mask:
    """Return a symmetric mask (V, V) of the pairs to match, among those that overlap.

    Kept are pairs that other ways through the views cannot stand in for (`_IRREPLACEABLE`), of each view the `_BEST`
    partners of largest shares, and `_SPREAD` more, evenly over the rest in the order of shares.

    Args:
        shares: (V, V) symmetric: share of the first view's points found in the second, plus the other way round.
        meet: (V, V) True for pairs that overlap.
    """
    kept = meet & (_leverage(np.where(meet, shares, 0.0)) > _IRREPLACEABLE)
    for v, meets_v in enumerate(meet):
        partners = np.flatnonzero(meets_v)
        best_first = partners[np.argsort(-shares[v, partners], kind="stable")]
        rest = best_first[_BEST:]
        if len(rest) > _SPREAD:
            rest = rest[((np.arange(_SPREAD) + 0.5) * len(rest) / _SPREAD).astype(int)]
        kept[v, best_first[:_BEST]] = kept[v, rest] = True
    return np.asarray(kept | kept.T)


def _leverage(weights: Array) -> Array:
    """Return the effective resistance (V, V) of each edge of a graph, times its weight (Spielman & Srivastava 2011).

    It is the share that the edge has in all that holds its two ends together: 1 of a bridge.

    Args:
        weights: (V, V) symmetric, zero on the diagonal and where there is no edge.
    """
    laplacian_inverse = np.linalg.pinv(np.diag(weights.sum(axis=1)) - weights, hermitian=True)
    diagonal = np.diag(laplacian_inverse)
    return np.asarray(weights * (diagonal[:, None] + diagonal - 2 * laplacian_inverse))
