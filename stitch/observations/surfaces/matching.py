"""Correspondences between views: KD-tree search in both directions, gated by distance and normal.

First which views overlap at all (`overlapping_pairs`), then what the sampled points of every view find in the others
(`match_pairs`). An iteration goes on from the search before: a point whose partner was clearly the nearest keeps it
while the views move little.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.session.scan import Scan, box_corners, even_indices
from stitch.system.threads import parallel

# Two patches whose normals differ by more than 45° are not the same surface.
_NORMAL_COSINE = np.cos(np.radians(45.0))
# Queries that decide whether two views overlap, and the share that must find a partner.
_PROBES = 250
MINIMUM_OVERLAP = 0.04
# Views in which one point of another view is asked for.
_MOST_PARTNERS = 20
# Nearest points are searched within so many gates: after little motion, what comes within the gate is known already.
_REACH = 1.1
# Where a larger share of the queries may have another nearest point, all are searched: that costs no more.
_MOST_OPEN = 0.5
# A view, and which of its sampled points are searched in another view.
QueryPart = tuple[int, slice]


def sample_points(scan: Scan, count: int) -> Indices:
    """Return indices (n,) of at most `count` usable points, evenly over the scan order; the same every time."""
    usable: Indices = np.flatnonzero(scan.usable).astype(np.int64)
    if len(usable) <= count:
        return usable
    picked: Indices = usable[even_indices(len(usable), count)]
    return picked


def near_pairs(scans: Sequence[Scan], poses: Array, gate: float) -> list[tuple[int, int]]:
    """Return the pairs (v < w) of scans whose boxes come within `gate`, length_unit: no others can correspond.

    The boxes are those of the scans in their own frames, placed by `poses` and boxed again along the reference axes.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
    """
    placed = [frames.transform(T, box_corners(scan.box)) for scan, T in zip(scans, poses, strict=True)]
    low, high = np.min(placed, axis=1), np.max(placed, axis=1)
    is_above = (low[:, None] - high[None] > gate).any(axis=2)
    v, w = np.nonzero(np.triu(~(is_above | is_above.T), 1))
    return list(zip(v.tolist(), w.tolist(), strict=True))


def overlapping_pairs(
    scans: Sequence[Scan], poses: Array, gate: float, at_most: int = _PROBES
) -> list[tuple[int, int]]:
    """Return the pairs (v < w) of which at least 4 % of the probed points meet.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
        gate: distance within which points meet, length_unit.
        at_most: points of a view that are probed; more than 250 tell nothing new.
    """
    queries = neighbour_queries(scans, poses, [sample_points(scan, min(at_most, _PROBES)) for scan in scans])
    near = near_pairs(scans, poses, gate)
    shares = overlap_shares(queries, near, gate)
    # A small view inside a large one: few of the large one's points meet, but most of the small one's do.
    shares |= overlap_shares(queries, [(w, v) for v, w in near if shares[v, w] < MINIMUM_OVERLAP], gate)
    return [(v, w) for v, w in near if max(shares[v, w], shares.get((w, v), 0.0)) >= MINIMUM_OVERLAP]


def overlap_shares(
    queries: "NeighbourQueries", pairs: Sequence[tuple[int, int]], gate: float
) -> dict[tuple[int, int], float]:
    """Return by pair (v, w) the share of view v's points that find a partner in view w.

    A partner is the nearest point within `gate` (length_unit) whose normal differs by at most 45°.

    Args:
        queries: points of all views that are searched.
        pairs: ordered pairs (v, w).
    """
    # The points of all views that are searched in one view go into its tree at once; the views in parallel.
    views_by_searched = defaultdict[int, list[int]](list)
    for v, w in pairs:
        views_by_searched[w].append(v)

    def shares_in(search: tuple[int, list[int]]) -> list[float]:
        """Return, for (w, views), the share of each of these views' points that find a partner in view w."""
        w, views = search
        parts = [(v, slice(None)) for v in views]
        _, points, normals = queries.gather(parts)
        accepted = np.split(queries.search(w, points, normals, gate)[1], np.cumsum(queries.counts(parts))[:-1])
        return [float(np.mean(of_view)) if len(of_view) else 0.0 for of_view in accepted]

    searches = views_by_searched.items()
    found = zip(searches, parallel(shares_in, searches), strict=True)
    return {(v, w): share for (w, views), shares in found for v, share in zip(views, shares, strict=True)}


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
        """Return some of the correspondences."""
        return Match(self.v, self.w, *(value[at] for value in self.columns))

    @property
    def columns(self) -> list[Any]:
        """All arrays, in the order of the fields."""
        return list(vars(self).values())[2:]

    def swapped(self) -> "Match":
        """Return the same correspondences with the roles of the two views exchanged."""
        return replace(self, v=self.w, w=self.v, residual=-self.residual, index_v=self.index_w, index_w=self.index_v)


@dataclass(frozen=True)
class Nearest:
    """The partners that N points of other views have in one view."""

    partner: NDArray[np.int32]  # (N,) usable point of the view; -1 where none lies within reach
    lead: Array  # (N,) float32: with less than half of it as motion no other point comes nearer within the gate


@dataclass(frozen=True)
class Searched:
    """The partners of the points of all views, kept so that after little motion few have to be searched again."""

    queries: "NeighbourQueries"
    parts: list[list[QueryPart]]  # per view the points that were searched in it
    gate: float  # largest distance between partners, length_unit
    nearest: list[Nearest]  # per view, of the points that were searched in it

    def still_open(
        self, queries: "NeighbourQueries", parts: list[list[QueryPart]], gate: float
    ) -> list[Indices] | None:
        """Return per view searched the numbers of the queries whose nearest point may be another under new poses.

        A distance to a point of a view changes by no more than the query moves, seen from that view. So the nearest
        point is the same while its lead over the second is more than twice that motion.

        Args:
            queries: the same points under the new poses.
            parts: per view searched, which points of which views are searched in it.
            gate: largest distance between corresponding points, length_unit.

        Returns:
            None where all queries are to be searched: other points, a larger gate, motion beyond what was searched
            (`_REACH`), or more than `_MOST_OPEN` of the queries open.
        """
        before = self.queries
        if gate > self.gate or parts != self.parts or len(queries.scans) != len(before.scans):
            return None
        same_scans = all(a.tree is b.tree for a, b in zip(before.scans, queries.scans, strict=True))
        if not (same_scans and all(map(np.array_equal, before.index, queries.index))):
            return None
        corners = np.array([box_corners(scan.box) for scan in queries.scans])
        still_open, total = list[Indices](), 0
        for w, (parts_in_w, nearest) in enumerate(zip(parts, self.nearest, strict=True)):
            v = [view for view, _ in parts_in_w]
            # A point inside a box moves no more than one of its corners.
            corners_before = frames.transform(frames.inverse(before.poses[w]) @ before.poses[v], corners[v])
            corners_now = frames.transform(frames.inverse(queries.poses[w]) @ queries.poses[v], corners[v])
            moved = np.linalg.norm(corners_now - corners_before, axis=2).max(axis=1)
            if gate + moved.max(initial=0.0) > _REACH * self.gate:
                return None
            still_open.append(np.flatnonzero(nearest.lead < np.repeat(2 * moved, queries.counts(parts_in_w))))
            total += len(nearest.lead)
        return still_open if sum(map(len, still_open)) < _MOST_OPEN * total else None


def match_pairs(
    scans: Sequence[Scan],
    poses: Array,
    pairs: Sequence[tuple[int, int]],
    gate: float,
    samples: Sequence[Indices],
    before: Searched | None = None,
    strides: Indices | None = None,
) -> tuple[list[Match], Searched]:
    """Return the correspondences of each pair of views that has some, and the search, for the next call's `before`.

    Each sampled point is matched with the nearest usable point of the other view, in both directions. With a stride t
    every t-th point of a view is searched in each other view, different points in different views: so the cost grows
    with the number of views, not with its square.

    Args:
        poses: T_reference_scanner, (V, 4, 4).
        pairs: (v, w) to match.
        gate: largest distance between corresponding points, length_unit.
        samples: per view the numbers of the points that are searched (see `sample_points`).
        before: a search under other poses: nearest points that cannot have changed are taken from it. None: all anew.
        strides: (V,) t of each view; None: so large that a point is searched in about `_MOST_PARTNERS` views.
    """
    if strides is None:
        strides = -(-np.bincount(np.array(pairs, int).ravel(), minlength=len(scans)) // _MOST_PARTNERS)
    # Per view, the points of other views that are searched in it.
    parts = [list[QueryPart]() for _ in scans]
    for v, w in pairs:
        for view, searched in ((v, w), (w, v)):
            parts[searched].append((view, slice(searched % strides[view], None, strides[view])))
    queries = neighbour_queries(scans, poses, samples)
    # Only the queries whose nearest point may have changed; None: all.
    still_open = None if before is None else before.still_open(queries, parts, gate)

    def search_view(w: int) -> tuple[Nearest, dict[int, Match]]:
        """Return the nearest points in view w of all queries, and by querying view the matches within the gate."""
        if not parts[w]:
            return Nearest(np.zeros(0, np.int32), np.zeros(0, np.float32)), {}
        index, points, normals = queries.gather(parts[w])
        if before is None or still_open is None:
            nearest = queries.nearest(w, points, gate)
            partner = nearest.partner
        else:
            nearest = before.nearest[w]
            partner = nearest.partner.copy()
            partner[still_open[w]] = queries.partners(w, points.take(still_open[w], axis=0), gate)
        return nearest, _partners_by_view(queries, w, parts[w], gate, partner, (index, points, normals))

    nearest, found = zip(*parallel(search_view, range(len(scans))), strict=True)
    matches = []
    for v, w in pairs:
        both_ways = [match for match in (found[w].pop(v), found[v].pop(w).swapped()) if len(match.residual)]
        if both_ways:
            columns = zip(*(match.columns for match in both_ways), strict=True)
            matches.append(Match(v, w, *(np.concatenate(column) for column in columns)))
    # A search of some queries is no new `before`: its leads are still those under the poses of the last full search.
    if before is None or still_open is None:
        # Points and normals under these poses are not needed again: the next search has its own.
        lean = replace(queries, poses=np.array(poses), points=[], normals=[])
        before = Searched(lean, parts, gate, list(nearest))
    return matches, before


def _partners_by_view(
    queries: "NeighbourQueries",
    w: int,
    parts: Sequence[QueryPart],
    gate: float,
    nearest: NDArray[np.int32],
    searched: tuple[Indices, Array, Array],
) -> dict[int, Match]:
    """Return by view v its matches in view w: pairs of points within the gate whose normals differ by less than 45°.

    Args:
        parts: which points of which views were searched in view w.
        gate: largest distance between corresponding points, length_unit.
        nearest: (N,) number of the nearest point of view w for each query, -1 where there is none.
        searched: index (N,), point and normal (N, 3), reference frame, of each query, in the order of `parts`.
    """
    scan, T = queries.scans[w], queries.poses[w]
    some = np.flatnonzero(nearest >= 0)
    index, partner = searched[0][some], nearest[some].astype(np.int64)
    # Rows of three by `take`: an index in brackets takes four times as long.
    p, n = searched[1].take(some, axis=0), searched[2].take(some, axis=0)
    q = frames.transform(T, scan.points.take(partner, axis=0))
    m = frames.rotate(T, scan.normals.take(partner, axis=0))
    difference, cosine = p - q, np.einsum("ij,ij->i", n, m)
    normal = n + m
    normal /= np.sqrt(np.einsum("ij,ij->i", normal, normal))[:, None]
    middle, residual = (p + q) / 2, np.einsum("ij,ij->i", difference, normal)
    keep = np.flatnonzero((np.einsum("ij,ij->i", difference, difference) < gate**2) & (cosine > _NORMAL_COSINE))
    bounds = np.searchsorted(some[keep], np.append(0, np.cumsum(queries.counts(parts))))
    matches = {}
    for (v, _), start, end in zip(parts, bounds[:-1], bounds[1:], strict=True):
        at = keep[start:end]
        i, j = index[at], partner[at]
        matches[v] = Match(
            v,
            w,
            middle.take(at, axis=0),
            normal.take(at, axis=0),
            residual[at],
            weight=scan.confidence[j] * queries.scans[v].confidence[i],
            index_v=i,
            index_w=j,
        )
    return matches


@dataclass(frozen=True)
class NeighbourQueries:
    """V views under one set of poses, and n points of each that look for partners."""

    scans: Sequence[Scan]
    poses: Array  # (V, 4, 4) T_reference_scanner
    index: Sequence[Indices]  # per view (n,)
    points: list[Array]  # per view (n, 3), reference frame
    normals: list[Array]  # per view (n, 3), reference frame

    def gather(self, parts: Sequence[QueryPart]) -> tuple[Indices, Array, Array]:
        """Return index (N,), point (N, 3) and normal (N, 3), reference frame, of some points, view after view."""
        index = np.concatenate([self.index[v][at] for v, at in parts])
        points = np.concatenate([self.points[v][at] for v, at in parts])
        return index, points, np.concatenate([self.normals[v][at] for v, at in parts])

    def counts(self, parts: Sequence[QueryPart]) -> list[int]:
        """Return how many points each part holds."""
        return [len(range(*at.indices(len(self.index[v])))) for v, at in parts]

    def nearest(self, w: int, points: Array, gate: float) -> Nearest:
        """Return the point of view w nearest to each of N points, and its lead: for how much motion it stays nearest.

        While a query moves by less than half of the lead, no other point comes nearer within the gate (`Nearest`).

        Args:
            points: (N, 3) reference frame.
            gate: largest distance between corresponding points, length_unit.
        """
        tree, reach = self.scans[w].tree, _REACH * gate
        count = min(2, tree.n)
        distance, index = tree.query(self._seen_from(w, points), k=count, distance_upper_bound=reach)
        first, second = distance.reshape(-1, count).T[[0, -1]]
        # A point beyond the gate has no partner until it has moved back into it.
        lead = np.maximum(np.minimum(second, reach) - first, 2 * (first - gate))
        return Nearest(self._usable(w, index.reshape(-1, count)[:, 0]), lead.astype(np.float32))

    def partners(self, w: int, points: Array, gate: float) -> NDArray[np.int32]:
        """Return the usable points (N,) of view w nearest to points (N, 3) of the reference frame, -1 for none."""
        return self._usable(w, self.scans[w].tree.query(self._seen_from(w, points), distance_upper_bound=gate)[1])

    def search(self, w: int, points: Array, normals: Array, gate: float) -> tuple[Array, NDArray[np.bool_]]:
        """Return two (N,): the distance of each point to view w (inf beyond the gate), and whether it has a partner.

        The nearest point is a partner if it is usable and its normal differs by less than 45°.

        Args:
            w: the view in which partners are sought.
            points, normals: (N, 3) reference frame.
            gate: largest distance between corresponding points, length_unit.
        """
        scan = self.scans[w]
        distance, index = scan.tree.query(self._seen_from(w, points), distance_upper_bound=gate)
        partner = self._usable(w, index)
        accept = partner >= 0
        near = np.flatnonzero(accept)
        facing = frames.rotate(frames.inverse(self.poses[w]), normals[near])
        accept[near] = np.einsum("ij,ij->i", facing, scan.normals[partner[near]]) > _NORMAL_COSINE
        return distance, accept

    def _usable(self, w: int, index: NDArray[np.uint32]) -> NDArray[np.int32]:
        """Return the indices (N,) of found points of view w, -1 where the point is not usable or none was found."""
        # Where none is found the tree gives the index one beyond the last.
        return np.where(np.append(self.scans[w].usable, False)[index], index.astype(np.int32), np.int32(-1))

    def _seen_from(self, w: int, points: Array) -> Array:
        """Return points (N, 3) of the reference frame in the scanner frame of view w, in which its tree stands."""
        return np.ascontiguousarray(frames.transform(frames.inverse(self.poses[w]), points))


def neighbour_queries(scans: Sequence[Scan], poses: Array, samples: Sequence[Indices]) -> NeighbourQueries:
    """Return sampled points of every view, placed by poses T_reference_scanner (V, 4, 4), to look for partners.

    Args:
        samples: per view the indices of its points.
    """
    placed = list(zip(scans, poses, samples, strict=True))
    points = [frames.transform(T, scan.points.take(index, axis=0)) for scan, T, index in placed]
    normals = [frames.rotate(T, scan.normals.take(index, axis=0)) for scan, T, index in placed]
    return NeighbourQueries(scans, poses, samples, points, normals)


def signed_distances(matches: Sequence[Match], poses: Array, points: Sequence[Array]) -> Array:
    """Return signed distances (M,) of all correspondences, (p_v − p_w)·n in length_unit, at other poses of the views.

    The correspondences and their normals n are those of the matches.

    Args:
        matches: M correspondences in all.
        poses: T_reference_scanner, (V, 4, 4).
        points: per scan (N, 3), scanner frame.
    """
    placed = [frames.transform(T, in_scanner) for T, in_scanner in zip(poses, points, strict=True)]
    distances = []
    for m in matches:
        difference = placed[m.v].take(m.index_v, axis=0) - placed[m.w].take(m.index_w, axis=0)
        distances.append(np.einsum("ij,ij->i", difference, m.normal))
    return np.concatenate(distances)
