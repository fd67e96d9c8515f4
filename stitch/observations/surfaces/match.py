"""Correspondences between views: KD-tree search in both directions, gated by distance and normal."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.scan import Scan, even_indices
from stitch.observations.surfaces.asking import NeighbourQueries, QueryPart, neighbour_queries
from stitch.system.threads import parallel

# Views in which one point of another view is asked for.
_MOST_PARTNERS = 20


@dataclass(frozen=True)
class Match:
    """Correspondences of one pair of views, in the reference frame; both search directions."""

    v: int
    w: int
    middle: Array  # (M, 3) midpoint of the two points
    normal: Array  # (M, 3) unit, mean of the two normals
    residual: Array  # (M,) signed distance (p_v − p_w)·normal
    weight: Array  # (M,) confidence × surface per point, mean 1 over the scan
    index_v: Indices  # (M,) point of view v
    index_w: Indices  # (M,) point of view w

    def subset(self, at: slice) -> "Match":
        """Some of them."""
        return Match(self.v, self.w, *(value[at] for value in self.columns))

    @property
    def columns(self) -> list[Any]:
        """All arrays, in the order of the fields."""
        return list(vars(self).values())[2:]

    def swapped(self) -> "Match":
        """The same as the other view sees it."""
        return replace(self, v=self.w, w=self.v, residual=-self.residual, index_v=self.index_w, index_w=self.index_v)


def sample_points(scan: Scan, count: int) -> Indices:
    """(n,) indices of at most `count` usable points, evenly over the scan order; the same every time."""
    usable: Indices = np.flatnonzero(scan.usable).astype(np.int64)
    if len(usable) <= count:
        return usable
    picked: Indices = usable[even_indices(len(usable), count)]
    return picked


def match_pairs(
    scans: Sequence[Scan],
    poses: Array,
    pairs: Sequence[tuple[int, int]],
    gate: float,
    samples: Sequence[Indices],
) -> Iterator[Match]:
    """Stream the correspondences of `pairs`: each sampled point with its nearest point of the other.

    Where a view overlaps with more than 20 others, its points take turns: each is asked for in 20 of them. What a point
    says of its own view it says to the first few already, so that many views cost what they are and not their square.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
        gate: largest distance between partners, length_unit.
        samples: per view the indices that search (see `sample`).
    """
    turns = -(-np.bincount(np.array(pairs, int).ravel(), minlength=len(scans)) // _MOST_PARTNERS)
    parts = [list[QueryPart]() for _ in scans]
    for v, w in pairs:
        for a, b in ((v, w), (w, v)):
            parts[b].append((a, slice(b % turns[a], None, turns[a])))
    every = neighbour_queries(scans, poses, samples)
    answers = list(parallel(lambda w: _partners_by_view(every, w, parts[w], gate), range(len(scans))))
    for v, w in pairs:
        found = [of for of in (answers[w].pop(v), answers[v].pop(w).swapped()) if len(of.residual)]
        if found:
            yield Match(v, w, *(np.concatenate(own) for own in zip(*(of.columns for of in found), strict=True)))


def signed_distances(matches: Sequence[Match], poses: Array, points: Sequence[Array]) -> Array:
    """(M,) signed distances of all correspondences, v less w along their normals, with the views elsewhere.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
        points: (N, 3) of every scan, scanner frame.
    """
    out = []
    for m in matches:
        p = frames.transform(poses[m.v], points[m.v][m.index_v])
        q = frames.transform(poses[m.w], points[m.w][m.index_w])
        out.append(np.einsum("ij,ij->i", p - q, m.normal))
    return np.concatenate(out)


def _partners_by_view(every: NeighbourQueries, w: int, parts: Sequence[QueryPart], gate: float) -> dict[int, Match]:
    """Per view v that asks, what its points found in view w: all that ask one view are looked for at once."""
    if not parts:
        return {}
    index, p, n = every.gather(parts)
    _, partner, accept = every.search(w, p, n, gate)
    bounds = np.append(0, np.cumsum(accept))[np.append(0, np.cumsum(every.counts(parts)))]
    index, p, partner, scan, T = index[accept], p[accept], partner[accept], every.scans[w], every.poses[w]
    q = frames.transform(T, scan.points[partner])
    normal = n[accept] + frames.rotate(T, scan.normals[partner])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    middle, residual, weight = (p + q) / 2, np.einsum("ij,ij->i", p - q, normal), scan.confidence[partner]
    found = {}
    for (v, _), start, end in zip(parts, bounds[:-1], bounds[1:], strict=True):
        # Copies: a part of a whole would keep all of it.
        i, j = index[start:end].copy(), partner[start:end].copy()
        m, n, r = (own[start:end].copy() for own in (middle, normal, residual))
        found[v] = Match(v, w, m, n, r, weight=weight[start:end] * every.scans[v].confidence[i], index_v=i, index_w=j)
    return found
