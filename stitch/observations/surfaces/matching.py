"""Correspondences between views: KD-tree search in both directions, gated by distance and normal."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.scan import Scan, bounding_box, box_corners, even_indices
from stitch.system.threads import parallel

# Sampled points of all views, placed in the reference frame once, and their search for nearest points of a view.

# Two patches whose normals differ by more than 45° are not the same surface.
_NORMAL_COSINE = np.cos(np.radians(45.0))
# Some of a view's sampled points.
QueryPart = tuple[int, slice]


@dataclass(frozen=True)
class NeighbourQueries:
    """V views under one set of poses, and n points of each that look for partners."""

    scans: Sequence[Scan]
    poses: Array  # (V, 4, 4) T_reference_scanner
    index: Sequence[Indices]  # per view (n,)
    points: list[Array]  # per view (n, 3), reference frame
    normals: list[Array]  # per view (n, 3), reference frame

    def gather(self, parts: Sequence[QueryPart]) -> tuple[Indices, Array, Array]:
        """Index, point and normal of some points of several views, one view after the other."""
        points, normals = (np.concatenate([own[v][at] for v, at in parts]) for own in (self.points, self.normals))
        return np.concatenate([self.index[v][at] for v, at in parts]), points, normals

    def counts(self, parts: Sequence[QueryPart]) -> list[int]:
        """How many points each part holds."""
        return [len(range(*at.indices(len(self.index[v])))) for v, at in parts]

    def search(self, w: int, points: Array, normals: Array, gate: float) -> tuple[Array, Indices, NDArray[np.bool_]]:
        """Of N points each (N,): distance (inf where none), index of the partner and whether it may be used.

        Args:
            w: the view in which partners are sought.
            points, normals: (N, 3) reference frame.
            gate: farthest partner, length_unit.
        """
        scan, T = self.scans[w], frames.inverse(self.poses[w])
        # The trees stay in their scanner's frame; the queries travel.
        query = np.ascontiguousarray(frames.transform(T, points))
        distance, partner = scan.tree.query(query, k=1, distance_upper_bound=gate)
        found = np.isfinite(distance)
        partner = np.where(found, partner, 0).astype(np.int64)
        accept = found & scan.usable[partner]
        near = np.flatnonzero(accept)
        cosine = np.einsum("ij,ij->i", frames.rotate(T, normals[near]), scan.normals[partner[near]])
        accept[near] = cosine > _NORMAL_COSINE
        return distance, partner, accept


def neighbour_queries(scans: Sequence[Scan], poses: Array, samples: Sequence[Indices]) -> NeighbourQueries:
    """Sampled points of every view under T_reference_scanner (V, 4, 4)."""
    every = list(zip(scans, poses, samples, strict=True))
    points = [frames.transform(T, scan.points[index]) for scan, T, index in every]
    return NeighbourQueries(
        scans, poses, samples, points, [frames.rotate(T, scan.normals[index]) for scan, T, index in every]
    )


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
    placed = [frames.transform(T, own) for T, own in zip(poses, points, strict=True)]
    along = [np.einsum("ij,ij->i", placed[m.v][m.index_v] - placed[m.w][m.index_w], m.normal) for m in matches]
    return np.concatenate(along)


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
    normal /= np.sqrt(np.einsum("ij,ij->i", normal, normal))[:, None]
    middle, residual, weight = (p + q) / 2, np.einsum("ij,ij->i", p - q, normal), scan.confidence[partner]
    found = {}
    for (v, _), start, end in zip(parts, bounds[:-1], bounds[1:], strict=True):
        # Copies: a part of a whole would keep all of it.
        i, j = index[start:end].copy(), partner[start:end].copy()
        m, n, r = (own[start:end].copy() for own in (middle, normal, residual))
        found[v] = Match(v, w, m, n, r, weight=weight[start:end] * every.scans[v].confidence[i], index_v=i, index_w=j)
    return found


# Which views overlap.

# Queries that decide whether two views overlap, and the share that must find a partner.
_PROBES = 250
MINIMUM_OVERLAP = 0.04


def overlapping_pairs(
    scans: Sequence[Scan], poses: Array, gate: float, at_most: int = _PROBES
) -> list[tuple[int, int]]:
    """Pairs (v < w) of which at least 4 % of the probed points meet; poses T_reference_scanner.

    Args:
        at_most: points of a view that are probed; more than 250 tell nothing new.
    """
    every = neighbour_queries(scans, poses, [sample_points(scan, min(at_most, _PROBES)) for scan in scans])

    def meeting(of_view: tuple[int, list[int]]) -> list[int]:
        """Of the views that ask one view, those of which enough points find a partner."""
        w, views = of_view
        parts = [(v, slice(None)) for v in views if len(every.index[v])]
        if not parts:
            return []
        _, points, normals = every.gather(parts)
        agree = np.split(every.search(w, points, normals, gate)[2], np.cumsum(every.counts(parts))[:-1])
        return [v for (v, _), own in zip(parts, agree, strict=True) if np.mean(own) >= MINIMUM_OVERLAP]

    def met(pairs: Sequence[tuple[int, int]]) -> set[tuple[int, int]]:
        """Of pairs (asking, asked) those that meet."""
        asked = defaultdict[int, list[int]](list)
        for v, w in pairs:
            asked[w].append(v)
        return {(v, w) for w, views in zip(asked, parallel(meeting, asked.items()), strict=True) for v in views}

    near = near_pairs(scans, poses, gate)
    found = met(near)
    found |= {(v, w) for w, v in met([(w, v) for v, w in near if (v, w) not in found])}
    return [pair for pair in near if pair in found]


def near_pairs(scans: Sequence[Scan], poses: Array, gate: float) -> list[tuple[int, int]]:
    """Pairs (v < w) whose bounding boxes come within `gate`: no others can have partners."""
    placed = [frames.transform(T, box_corners(bounding_box(scan.points))) for scan, T in zip(scans, poses, strict=True)]
    low, high = np.min(placed, axis=1), np.max(placed, axis=1)
    apart = (low[:, None] - high[None] > gate).any(axis=2)
    v, w = np.nonzero(np.triu(~(apart | apart.T), 1))
    return list(zip(v.tolist(), w.tolist(), strict=True))
