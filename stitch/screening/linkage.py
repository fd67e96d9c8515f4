"""Which views hold each other, and which show a surface where others show it elsewhere.

Two views are linked if most of their correspondences close within the robust gate. A pair that only lies near, with
surfaces that cross, has correspondences too, but they do not close: it links nothing, and the robust weights of the fit
ignore it without a word. Partners beyond the gate are no partners: a scan may keep its few that fit and contradict all
others. So every scan is asked whether others show elsewhere what it shows.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stitch.numerics import frames
from stitch.numerics.distributions import binomial_tail
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.matching import QueryPart, near_pairs, neighbour_queries, sample_points
from stitch.observations.surfaces.normal_equations import Overlaps
from stitch.session.scan import Scan
from stitch.system.threads import parallel

# Share of a pair's correspondences within four robust sigmas. Pairs of good sessions have 0.7 to 1, simulated and
# real; pairs with a view displaced by more than the gate 0 to 0.3.
LINKED_SHARE = 0.5
# Correspondences that determine six numbers with some to spare.
HOLDING = 20
# The same side of a part: normals within 45°; at the same place: within two spacings along the surface.
_SAME_SIDE, _SPACINGS = np.cos(np.radians(45.0)), 2.0
# Elsewhere is farther than so many tolerances: what a lens or a slant does to a scan moves it by less.
_OFF_SURFACE_TOLERANCES = 3.0
# Points of a scan that are asked, in so many other scans each (with more they take turns), and how far from their
# surface, as a share of the part's size.
_CONTRADICTION_PROBES, _VIEWS_COMPARED, _SEARCH_REACH = 500, 20, 0.1
# A scan contradicts the others if this share of what they show of it stands elsewhere; one that was put where it fits
# best, and still does by the second, is torn.
CONTRADICTS, STILL_CONTRADICTS = 0.2, 0.05
# The chance of as many where the share is no larger: of a scan seen from its edge others show few points.
_CONTRADICTION_CHANCE = 1e-4

# Per point what a scan shows of it: 2 in its place, 1 elsewhere, 0 nothing, or neither.
PointVisibility = NDArray[np.int8]


@dataclass(frozen=True)
class Linkage:
    """The graph of overlaps of V views; components are sorted, largest first."""

    views: int
    components: tuple[tuple[int, ...], ...]
    only_links: tuple[tuple[int, int], ...]  # (view, partner) of views that no other pair holds

    @property
    def core(self) -> tuple[int, ...]:
        """The largest component."""
        return self.components[0]

    @property
    def unlinked(self) -> tuple[int, ...]:
        """Views outside the largest component."""
        return tuple(sorted(v for part in self.components[1:] for v in part))


def linkage(overlaps: Overlaps, holding_nothing: Collection[int] = ()) -> Linkage:
    """Return which views are linked, by the share of each pair's correspondences that lie within the robust gate.

    Pairs with common targets are always linked.

    Args:
        holding_nothing: views whose scans determine no pose, as points in a line: no surface links them.
    """
    gram = overlaps.gram
    matched = {(m.v, m.w): len(m.residual) for m in overlaps.matches}
    linked = list[tuple[int, int]]()
    for (v, w), within_gate, labelled in zip(gram.pairs.tolist(), gram.count.tolist(), gram.labelled, strict=True):
        holds = pair_holds(within_gate, matched.get((v, w), 0)) and not {v, w} & {*holding_nothing}
        # Common targets have names: they always belong together.
        if labelled or holds:
            linked.append((v, w))
    return linkage_of_pairs(gram.views, linked)


def pair_holds(within_gate: int, matched: int) -> bool:
    """Return whether a pair's correspondences, of which so many lie within the robust gate, determine its motion."""
    return within_gate >= HOLDING and within_gate >= LINKED_SHARE * matched > 0


def linkage_of_pairs(views: int, pairs: Sequence[tuple[int, int]]) -> Linkage:
    """Return the linkage of V views from linked pairs: connected components, largest first, and views with one link."""
    near = np.zeros((views, views), bool)
    for v, w in pairs:
        near[v, w] = near[w, v] = True
    only_links = [(v, int(np.argmax(near[v]))) for v in range(views) if near[v].sum() == 1]
    count, label = connected_components(coo_array(near), directed=False)
    parts = [tuple(int(v) for v in np.flatnonzero(label == k)) for k in range(count)]
    return Linkage(views, tuple(sorted(parts, key=lambda part: (-len(part), part))), tuple(only_links))


def find_contradicting_views(
    scans: Sequence[Scan],
    poses: Array,
    tolerance: float,
    size: float,
    share: float = CONTRADICTS,
    groups: Sequence[Sequence[int]] = (),
) -> tuple[int, ...]:
    """Return the views that show a surface which other views show elsewhere, the worst first.

    Residuals do not show such a scan: points beyond the gate have no correspondence, the few that fit remain. The part
    may have moved during it, or two scans be in one file. The worst view is taken out and the others are tested again
    without it, until none is left.

    Args:
        poses: (V, 4, 4) T_reference_scanner at which the views fit best.
        tolerance: distance along the normal that is the same place, length_unit.
        size: of the part, length_unit.
        share: a view contradicts if significantly more of its points that others show stand elsewhere.
        groups: linked views: each is compared within its group, since groups may be displaced. (): with all.
    """
    visibility = _point_visibility(scans, poses, tolerance, _SEARCH_REACH * size)
    for group in groups:
        for v in group:
            visibility[v] = {w: by_w for w, by_w in visibility[v].items() if w in group}
    contradicting = list[int]()
    while True:
        shares = [
            0.0 if v in contradicting else _contradicted_share(by_view, contradicting, share)
            for v, by_view in enumerate(visibility)
        ]
        worst = int(np.argmax(shares))
        if not shares[worst]:
            return tuple(contradicting)
        contradicting.append(worst)


def _contradicted_share(visibility: dict[int, PointVisibility], without: Sequence[int], least: float) -> float:
    """Return the share of a view's points, of those that other views show at all, that none shows in place.

    0 if the share is not significantly above `least`, by a binomial test.

    Args:
        visibility: by other view, what it shows of each point.
        without: views that do not count.
    """
    others = [by_view for w, by_view in visibility.items() if w not in without]
    if not others:
        return 0.0
    best = np.max(others, axis=0)
    elsewhere = int(np.sum(best == 1))
    seen = int(np.sum(best > 0))
    return elsewhere / seen if binomial_tail(elsewhere - 1, seen, least) < _CONTRADICTION_CHANCE else 0.0


def _point_visibility(
    scans: Sequence[Scan], poses: Array, tolerance: float, reach: float
) -> list[dict[int, PointVisibility]]:
    """Return per view v, by each view w near it, what w shows of the probed points (n,) of v (`PointVisibility`).

    Where many views are near, each is asked for every k-th point only, and shows 0 of the others.

    Args:
        poses: (V, 4, 4) T_reference_scanner.
        tolerance: distance along the normal that is the same place, length_unit.
        reach: how far from a point another surface is sought, length_unit.
    """
    near: list[list[int]] = [[] for _ in scans]
    for v, w in near_pairs(scans, poses, reach):
        near[v].append(w)
        near[w].append(v)

    queries = neighbour_queries(scans, poses, [sample_points(scan, _CONTRADICTION_PROBES) for scan in scans])
    # By view w, the points of other views that are sought in it: the view v, and a stride over its points.
    asked: list[list[QueryPart]] = [[] for _ in scans]
    for v, others in enumerate(near):
        stride = -(-len(others) // _VIEWS_COMPARED)
        for k, w in enumerate(others):
            asked[w].append((v, slice(k % stride, None, stride)))

    def answers_of(w: int) -> list[PointVisibility]:
        """Return what view w shows of the points that are sought in it, part by part; they are searched at once."""
        if not asked[w]:
            return []
        _, points, normals = queries.gather(asked[w])
        T = frames.inverse(poses[w])
        _, along, across = _nearest_partners(scans[w], frames.transform(T, points), frames.rotate(T, normals), reach)
        at_same_place = across < _SPACINGS * scans[w].spacing
        tolerances_off = np.abs(along) / tolerance
        in_place = at_same_place & (tolerances_off < 1)
        elsewhere = at_same_place & (tolerances_off > _OFF_SURFACE_TOLERANCES)
        return np.split(2 * in_place + elsewhere, np.cumsum(queries.counts(asked[w]))[:-1])

    visibility = [{w: np.zeros(len(index), np.int8) for w in near[v]} for v, index in enumerate(queries.index)]
    for w, answers in enumerate(parallel(answers_of, range(len(scans)))):
        for (v, points_asked), answer in zip(asked[w], answers, strict=True):
            visibility[v][w][points_asked] = answer
    return visibility


def points_in_place(scan: Scan, points: Array, normals: Array, tolerance: float) -> Mask:
    """Return a mask (n,) of points that a scan shows at their place, along its normal and across.

    Across means within two local spacings, so that a sparse scan counts too.

    Args:
        points, normals: (n, 3) in the scan's frame.
        tolerance: distance along the normal, length_unit.
    """
    reach = float(np.sqrt(scan.area.max())) * _SPACINGS + tolerance
    index, along, across = _nearest_partners(scan, points, normals, reach)
    return (np.abs(along) < tolerance) & (across < _SPACINGS * np.sqrt(scan.area[index]))


def _nearest_partners(scan: Scan, points: Array, normals: Array, reach: float) -> tuple[Indices, Array, Array]:
    """Return per point the number (n,) of a scan's nearest point, and the distances (n,) along its normal and across.

    The distance across is infinite where none is within `reach`, and where it is an edge or faces the other way.

    Args:
        points, normals: (n, 3) in the scan's frame.
        reach: length_unit.
    """
    distance, partner = scan.tree.query(np.ascontiguousarray(points), distance_upper_bound=reach)
    same_side = np.isfinite(distance)
    partner = np.where(same_side, partner, 0).astype(np.int64)
    normal = scan.normals.take(partner, axis=0)
    along = np.einsum("ni,ni->n", points - scan.points.take(partner, axis=0), normal)
    same_side &= scan.usable[partner] & (np.einsum("ni,ni->n", normals, normal) > _SAME_SIDE)
    across = np.sqrt(np.maximum(distance**2 - along**2, 0.0), where=same_side, out=np.full(len(points), np.inf))
    return partner, along, across
