"""Find where a scan belongs among the others, tried wide: from many starts, by the surface alone.

Point-to-plane ICP (Chen & Medioni 1992) of one scan against the surface of other views, all starts at once, with a
gate that shrinks. A placement is judged by its closure: of the points that come to lie near the other surface, the
share that lies on it.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pykdtree.kdtree import KDTree
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.numerics.distributions import binomial_tail
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.matching import near_pairs, sample_points
from stitch.observations.surfaces.normal_equations import Overlaps
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.session.capture import Capture, part_size
from stitch.session.scan import Scan
from stitch.system.threads import parallel

# The same side of a part: normals within 45°; at the same place: within two spacings along the surface.
_SAME_SIDE, _SPACINGS = np.cos(np.radians(45.0)), 2.0
# Elsewhere is farther than so many tolerances: what a lens or a slant does to a scan moves it by less.
_OFF_SURFACE_TOLERANCES = 3.0

# Per point what a scan shows of it: 2 in its place, 1 elsewhere, 0 nothing, or neither.
PointVisibility = NDArray[np.int8]


def classify_visibility(scan: Scan, points: Array, normals: Array, limits: tuple[float, float]) -> PointVisibility:
    """Return (n,) what a scan shows of points (n, 3) with normals (n, 3), in its frame.

    Args:
        limits: distance along the normal that is the same place, and how far is looked, length_unit.
    """
    tolerance, reach = limits
    _, along, beside = nearest_partners(scan, points, normals, reach)
    found, away = beside < _SPACINGS * scan.spacing, np.abs(along) / tolerance
    return np.asarray(2 * (found & (away < 1)) + (found & (away > _OFF_SURFACE_TOLERANCES)), np.int8)


def points_in_place(scan: Scan, points: Array, normals: Array, tolerance: float) -> Mask:
    """(n,) bool: points that a scan shows where they are, however sparse it is there."""
    reach = float(np.sqrt(scan.area.max())) * _SPACINGS + tolerance
    index, along, beside = nearest_partners(scan, points, normals, reach)
    return np.asarray((np.abs(along) < tolerance) & (beside < _SPACINGS * np.sqrt(scan.area[index])))


def nearest_partners(scan: Scan, points: Array, normals: Array, reach: float) -> tuple[Indices, Array, Array]:
    """Return the point of a scan (n,) nearest to each one in its frame, and how far that is (n,) along and beside its
    normal: infinitely far beside where it is none, or of the other side of the part."""
    distance, partner = scan.tree.query(np.ascontiguousarray(points), distance_upper_bound=reach)
    found = np.isfinite(distance)
    partner = np.where(found, partner, 0).astype(np.int64)
    own = scan.normals.take(partner, axis=0)
    along = np.einsum("ni,ni->n", points - scan.points.take(partner, axis=0), own)
    found &= scan.usable[partner] & (np.einsum("ni,ni->n", normals, own) > _SAME_SIDE)
    beside = np.sqrt(np.maximum(distance**2 - along**2, 0.0), where=found, out=np.full(len(points), np.inf))
    return partner, along, beside


# Points of a scan that are asked, in so many other scans each (with more they take turns), and how far from their
# surface, as a share of the part's size.
_CONTRADICTION_PROBES, _VIEWS_COMPARED, _SEARCH_REACH = 500, 20, 0.1
# A scan contradicts the others if this share of what they show of it stands elsewhere; one that was put where it fits
# best, and still does by the second, is torn.
CONTRADICTS, STILL_CONTRADICTS = 0.2, 0.05
# The chance of as many where the share is no larger: of a scan seen from its edge others show few points.
_CONTRADICTION_CHANCE = 1e-4


def find_contradicting_views(
    scans: Sequence[Scan],
    poses: Array,
    tolerance: float,
    size: float,
    share: float = CONTRADICTS,
    groups: Sequence[Sequence[int]] = (),
) -> tuple[int, ...]:
    """Find views that show a surface where others show it elsewhere, facing the same way; the worst first.

    Partners beyond the gate are no partners, so that such a scan keeps its few that fit and seems to fit well, and the
    stitched cloud gets a second surface beside the first. What is torn in itself, because the part moved during the
    scan or two scans are in one file, fits with one half and contradicts with the other. Each view is asked without
    those before it.

    Args:
        poses: (V, 4, 4) T_reference_scanner at which the views fit best.
        tolerance: distance along the normal that is the same place, length_unit.
        size: of the part, length_unit.
        share: of what others show of a view that stands elsewhere.
        groups: views that link each other: only within one is each asked, since groups may stand apart. Empty: all are.
    """
    said = _point_visibility(scans, poses, tolerance, _SEARCH_REACH * size)
    for group in groups:
        for v in group:
            said[v] = {w: shown for w, shown in said[v].items() if w in group}
    out = list[int]()
    while True:
        shares = [0.0 if v in out else _contradicted_share(own, out, share) for v, own in enumerate(said)]
        worst = int(np.argmax(shares))
        if not shares[worst]:
            return tuple(out)
        out.append(worst)


def _contradicted_share(own: dict[int, PointVisibility], without: Sequence[int], least: float) -> float:
    """Return the share of points shown by other views that all of these show elsewhere; 0 up to the least one."""
    others = [shown for w, shown in own.items() if w not in without]
    if not others:
        return 0.0
    best = np.max(others, axis=0)
    elsewhere, asked = int(np.sum(best == 1)), int(np.sum(best > 0))
    return elsewhere / asked if binomial_tail(elsewhere - 1, asked, least) < _CONTRADICTION_CHANCE else 0.0


def _point_visibility(
    scans: Sequence[Scan], poses: Array, tolerance: float, reach: float
) -> list[dict[int, PointVisibility]]:
    """Per view and other view what that shows of each asked point (n,)."""
    near: list[list[int]] = [[] for _ in scans]
    for v, w in near_pairs(scans, poses, reach):
        near[v].append(w)
        near[w].append(v)

    def of_view(v: int) -> dict[int, PointVisibility]:
        scan, turns = scans[v], -(-len(near[v]) // _VIEWS_COMPARED)
        index = sample_points(scan, _CONTRADICTION_PROBES)
        shown = {w: np.zeros(len(index), np.int8) for w in near[v]}
        for k, w in enumerate(near[v]):
            asked, T_w_v = slice(k % turns, None, turns), frames.inverse(poses[w]) @ poses[v]
            points = frames.transform(T_w_v, scan.points.take(index[asked], axis=0))
            normals = frames.rotate(T_w_v, scan.normals.take(index[asked], axis=0))
            shown[w][asked] = classify_visibility(scans[w], points, normals, (tolerance, reach))
        return shown

    return list(parallel(of_view, range(len(scans))))


# Two views are linked if most of their correspondences close within the robust gate. A pair that only lies near, with
# surfaces that cross, has correspondences too, but they do not close: it links nothing, and the robust weights of the
# fit ignore it without a word.
# Share of a pair's correspondences within four robust sigmas. Pairs of good sessions have 0.7 to 1, simulated and
# real; pairs with a view displaced by more than the gate 0 to 0.3.
LINKED_SHARE = 0.5
# Correspondences that determine six numbers with some to spare.
HOLDING = 20


@dataclass(frozen=True)
class Link:
    """The overlap of two views."""

    v: int
    w: int
    count: int  # correspondences within the robust gate
    share: float  # of all correspondences of the pair, 0 … 1

    @property
    def holds(self) -> bool:
        """True if the pair says something about its two poses."""
        return self.share >= LINKED_SHARE and self.count >= HOLDING


@dataclass(frozen=True)
class Linkage:
    """The graph of overlaps of V views; components are sorted, largest first."""

    views: int
    components: tuple[tuple[int, ...], ...]
    single: tuple[tuple[int, int], ...]  # (view, partner): held by this one pair alone

    @property
    def core(self) -> tuple[int, ...]:
        """The largest component."""
        return self.components[0]

    @property
    def unlinked(self) -> tuple[int, ...]:
        """Views outside the largest component."""
        return tuple(sorted(v for part in self.components[1:] for v in part))


def linkage(overlaps: Overlaps, holding_nothing: Collection[int] = ()) -> Linkage:
    """Find components, and views held by a single pair, from the correspondences at the poses of `overlaps`.

    Args:
        holding_nothing: views whose scans hold no pose, however well they lie on the others.
    """
    views = overlaps.gram.views
    found = {(m.v, m.w): len(m.residual) for m in overlaps.matches}
    links = []
    for i, (v, w) in enumerate(overlaps.gram.pairs):
        if overlaps.gram.labelled[i]:
            # Common targets have names: they always belong together.
            links.append(Link(int(v), int(w), HOLDING, 1.0))
        elif v in holding_nothing or w in holding_nothing:
            continue
        elif found.get((int(v), int(w))):
            count = int(overlaps.gram.count[i])
            links.append(Link(int(v), int(w), count, count / found[int(v), int(w)]))
    return linkage_of_links(views, links)


def linkage_of_links(views: int, links: Sequence[Link]) -> Linkage:
    """Return the linkage of V views from their links."""
    near = np.zeros((views, views), bool)
    for link in links:
        near[link.v, link.w] = near[link.w, link.v] = link.holds
    single = [(v, int(np.argmax(near[v]))) for v in range(views) if near[v].sum() == 1]
    count, label = connected_components(coo_array(near), directed=False)
    parts = [tuple(int(v) for v in np.flatnonzero(label == k)) for k in range(count)]
    return Linkage(views, tuple(sorted(parts, key=lambda part: (-len(part), part))), tuple(single))


# Points of the other views that make up their surface, and of the scan that is placed.
_SURFACE_POINTS = 30_000
_COARSE_PROBES, _FINAL_PROBES = 160, 600
_NORMAL_COSINE = np.cos(np.radians(45.0))
# Gates of the search as shares of the size: from a third of the part to a two-hundredth.
_FIRST_GATE, _LAST_GATE, _STEPS = 0.35, 0.005, 14
_FINAL_STEPS = 15
_KEPT = 4
# A scan of a line or of a point has no second direction: its extent there, as a share of the largest.
_LINE = 1e-3
_FEWEST = 30


@dataclass(frozen=True)
class ReferenceSurface:
    """Points of several views in the reference frame, with normals."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3)
    tree: Any
    spacing: float  # median distance between neighbours of one scan
    tolerance: float  # a point this far from the surface, along the normal, lies on it

    @property
    def near(self) -> float:
        """Distance from its points within which a point lies near the surface."""
        return 2 * self.spacing + 3 * self.tolerance

    def meets(self, poses: Array, points: Array, normals: Array, gate: float) -> tuple[Array, Array, Mask, Mask]:
        """Signed distance (S, n), normal of the partner (S, n, 3), and: one within `gate` faces alike, one is near."""
        placed = frames.transform(poses, points)
        distance, partner = self.tree.query(np.ascontiguousarray(placed.reshape(-1, 3)), distance_upper_bound=gate)
        near = np.isfinite(distance).reshape(placed.shape[:2])
        partner = np.where(near, partner.reshape(near.shape), 0).astype(np.int64)
        normal = self.normals[partner]
        alike = np.einsum("snj,snj->sn", frames.rotate(poses, normals), normal) > _NORMAL_COSINE
        return np.einsum("snj,snj->sn", placed - self.points[partner], normal), normal, near & alike, near


@dataclass(frozen=True)
class Placement:
    """A scan placed on a surface."""

    T: Array  # (4, 4) T_reference_scanner
    near: float  # share of its points that lie near the surface
    closure: float  # share of those that lie on it

    @property
    def surface_share(self) -> float:
        """Share of all its points that lie on the surface."""
        return self.near * self.closure


def surface_of(scans: Sequence[Scan], poses: Array, views: Iterable[int], tolerance: float) -> ReferenceSurface:
    """Return the surface that some views show under poses (V, 4, 4) T_reference_scanner."""
    views = list(views)
    picked = {v: sample_points(scans[v], max(_SURFACE_POINTS // max(len(views), 1), 200)) for v in views}
    points, normals = _points_of(scans, poses, picked)
    spacing = float(
        np.median([scans[v].spacing * np.sqrt(len(scans[v].points) / max(len(picked[v]), 1)) for v in views])
    )
    return ReferenceSurface(points, normals, KDTree(np.ascontiguousarray(points), leafsize=16), spacing, tolerance)


def _points_of(scans: Sequence[Scan], poses: Array, picked: Mapping[int, Indices]) -> tuple[Array, Array]:
    """Return some points (N, 3) of views, and normals, in the reference frame."""
    points = [frames.transform(poses[v], scans[v].points[index]) for v, index in picked.items()]
    normals = [frames.rotate(poses[v], scans[v].normals[index]) for v, index in picked.items()]
    return np.concatenate(points), np.concatenate(normals)


def shows_no_surface(scan: Scan) -> bool:
    """True for a scan of so few points, or of points in one line, that it fits anywhere."""
    return bool(scan.usable.sum() < _FEWEST) or lies_in_a_line(scan)


def lies_in_a_line(scan: Scan) -> bool:
    """True for a scan of points in one straight line: on a flat part it lies on the surface, and holds nothing."""
    extent = np.linalg.svd(scan.points - scan.points.mean(axis=0), compute_uv=False)
    return bool(extent[1] < _LINE * extent[0])


def evaluate_placement(scan: Scan, T: Array, surface: ReferenceSurface) -> Placement:
    """Return how well a scan lies on a surface under a pose (4, 4)."""
    return evaluate_placements(scan, T[None], surface)[0]


def evaluate_placements(
    scan: Scan, poses: Array, surface: ReferenceSurface, probes: int = _FINAL_PROBES
) -> list[Placement]:
    """Return how well a scan lies on a surface under each pose (S, 4, 4)."""
    index = sample_points(scan, probes)
    if not len(index):
        return [Placement(T, 0.0, 0.0) for T in poses]
    residual, _, meets, inside = surface.meets(poses, scan.points[index], scan.normals[index], surface.near)
    on = meets & (np.abs(residual) < surface.tolerance)
    return [
        Placement(T, float(i.mean()), float(o.sum() / max(i.sum(), 1)))
        for T, i, o in zip(poses, inside, on, strict=True)
    ]


def place_scan(scan: Scan, surface: ReferenceSurface, starts: Array, size: float) -> list[Placement]:
    """Close in from every start (S, 4, 4); return the best few placements, best first.

    Args:
        size: of the part, length_unit: the search reaches a third of it.
    """
    gates = size * np.geomspace(_FIRST_GATE, _LAST_GATE, _STEPS)
    gates = np.maximum(gates, 1.5 * surface.spacing)
    poses = _icp_scan(scan, surface, starts, gates, _COARSE_PROBES)
    found = evaluate_placements(scan, poses, surface, 300)
    best = sorted(range(len(found)), key=lambda i: -found[i].surface_share)[:_KEPT]
    fine = np.full(_FINAL_STEPS, gates[-1])
    poses = _icp_scan(scan, surface, poses[best], fine, _FINAL_PROBES)
    return sorted(evaluate_placements(scan, poses, surface), key=lambda p: -p.surface_share)


def _icp_scan(scan: Scan, surface: ReferenceSurface, starts: Array, gates: Array, probes: int) -> Array:
    """(S, 4, 4) after one Gauss–Newton step per gate, all starts side by side."""
    index = sample_points(scan, probes)
    points, normals = scan.points[index], scan.normals[index]
    poses = np.array(starts)
    centre = points.mean(axis=0)
    lever = float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean())) or 1.0
    for gate in gates:
        residual, normal, found, _ = surface.meets(poses, points, normals, gate)
        # Twists about each pose's own centre, rotations in units of the lever: well scaled at every start.
        arm = frames.transform(poses, points) - frames.transform(poses, centre[None])
        J = np.concatenate([np.cross(arm, normal) / lever, normal], axis=2)
        spread = np.median(np.where(found, np.abs(residual), np.nan_to_num(gate)), axis=1)
        cut = np.maximum(3 * 1.4826 * spread, 2 * surface.tolerance)[:, None]
        weight = found * np.clip(1 - (residual / np.maximum(cut, 1e-300)) ** 2, 0, None) ** 2
        H = np.einsum("sn,sni,snj->sij", weight, J, J, optimize=True)
        b = np.einsum("sn,sni,sn->si", weight, J, residual, optimize=True)
        H += 1e-4 * (np.trace(H, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(6)
        step = -np.linalg.solve(H, b[..., None])[..., 0]
        step[:, :3] /= lever
        to = frames.make(np.eye(3), -frames.transform(poses, centre[None])[:, 0])
        poses = frames.inverse(to) @ frames.exp(step) @ to @ poses
    return poses


def starts_about(T: Array, scan: Scan, size: float) -> Array:
    """(S, 4, 4) a pose and its neighbours: a third of the part along, and 12° about, each axis."""
    centre = frames.transform(T, scan.points.mean(axis=0)[None])[0]
    to = frames.make(np.eye(3), -centre)
    turns = [frames.make(Rotation.from_rotvec(a * np.radians(12)).as_matrix(), np.zeros(3)) for a in _AXES]
    shifts = [frames.make(np.eye(3), a * _FIRST_GATE * size) for a in _AXES]
    return np.array([T] + [frames.inverse(to) @ move @ to @ T for move in (*turns, *shifts)])


_AXES = np.vstack([np.eye(3), -np.eye(3)])


def starts_anywhere(surface: ReferenceSurface, scan: Scan, turns: int = 48) -> Array:
    """(S, 4, 4) the scan's centre on the surface's centre, turned every way."""
    R = Rotation.random(turns, rng=np.random.default_rng(0)).as_matrix()
    own, there = scan.points.mean(axis=0), surface.points.mean(axis=0)
    return frames.make(R, there - R @ own)


# Points of each view that stand for it in its group.
_GROUP_PROBES = 600
# What shows less than this share of the surface cannot be seen to belong there.
FEW_SHARED = 0.1


def place_groups(capture: Capture, poses: Array, linked: Linkage, limits: tuple[float, float]) -> dict[int, Placement]:
    """Find where the views of groups outside the core belong, each group moved as a whole; the core grows with them.

    What displaces the views of a group they share. Each alone may show too little of the others, or close in a wrong
    place; all of them close in one.

    Args:
        poses: (V, 4, 4) T_reference_scanner at which the views of each group fit together.
        limits: distance from the surface that still lies on it, length_unit, and the closure needed.
    """
    (tolerance, needed), size = limits, part_size([capture])
    core, placed = list(linked.core), dict[int, Placement]()
    for group in (part for part in linked.components[1:] if len(part) > 1):
        surface = surface_of(capture.scans, poses, core, tolerance)
        scan = _merge_scans(capture.scans, poses, group)
        found = place_scan(scan, surface, starts_about(np.eye(4), scan, size), size)
        closed = [p for p in found if _group_closes(scan, p.T, surface, needed)]
        if not closed:
            continue
        # A part may look alike from several sides: of the places in which the group closes, the nearest.
        T = min(closed, key=lambda p: float(np.sum((frames.transform(p.T, scan.points) - scan.points) ** 2))).T
        placed |= {v: evaluate_placement(capture.scans[v], T @ poses[v], surface) for v in group}
        core += group
        poses = np.array([T @ pose if v in group else pose for v, pose in enumerate(poses)])
    return placed


def _merge_scans(scans: Sequence[Scan], poses: Array, group: Sequence[int]) -> Scan:
    """Return some points of all views of a group as one scan in the reference frame."""
    picked = {v: sample_points(scans[v], _GROUP_PROBES) for v in group}
    points, normals = _points_of(scans, poses, picked)
    return replace(
        scans[group[0]],
        points=points,
        normals=normals,
        usable=np.ones(len(points), bool),
        area=np.concatenate([scans[v].area[picked[v]] for v in group]),
        confidence=np.concatenate([scans[v].confidence[picked[v]] for v in group]),
        tree=KDTree(points, leafsize=16),
    )


def _group_closes(scan: Scan, T: Array, surface: ReferenceSurface, needed: float) -> bool:
    """True if enough of what faces the surface lies on it.

    Halves of a session may show the two sides of a thin wall: there what is near and faces the other way says nothing.
    """
    residual, _, meets, _ = surface.meets(T[None], scan.points, scan.normals, surface.near)
    on = meets & (np.abs(residual) < surface.tolerance)
    return bool(meets.mean() > FEW_SHARED and on.sum() > needed * meets.sum())


# A placement is right if at least this share of what linked views have on the others' surface lies on it. Right ones
# have 0.9 to 1 of it, scans of other parts up to 0.35, scaled by 2.5 % up to 0.7.
_ACCEPTED_CLOSURE = 0.8
# A placement at some row's very pose is believed sooner: by chance none lies there. Other parts still do not reach it.
_CLOSURE_AT_ROW = 0.75
CLOSE_SHARE = 0.03  # of the part's size
# Another place is as good as the best one if so large a share of what lies on the surface there does so.
_AS_GOOD = 0.8
_NEAR_GATE = 0.2


def needed_closure(capture: Capture, poses: Array, linked: Linkage, tolerance: float) -> float:
    """Return the share of a scan on the surface of the others at which it counts as placed."""
    core = linked.core
    if not linked.unlinked or len(core) < 2:
        return _ACCEPTED_CLOSURE
    usual = [
        evaluate_placement(
            capture.scans[v], poses[v], surface_of(capture.scans, poses, [w for w in core if w != v], tolerance)
        ).closure
        for v in core[:: max(len(core) // 6, 1)]
    ]
    return _ACCEPTED_CLOSURE * float(np.median(usual))


def place_unlinked_views(
    capture: Capture,
    model_poses: Array,
    unconstrained: UnconstrainedPoses,
    linked: Linkage,
    limits: tuple[float, float],
) -> tuple[dict[int, Placement], list[int], set[int]]:
    """Find where the views outside the core belong, and those that belong nowhere; the core grows as they are placed.

    On a part that looks alike from several sides a view may close at several places: which is its own is not known, and
    it belongs nowhere unless one of them is its row's.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner by the robot.
        limits: distance from the surface that still lies on it, length_unit, and the closure needed.

    Returns:
        Views that are placed, those that are not, and of these the ones that close at several places.
    """
    if not linked.unlinked or len(linked.core) < 2:
        return {}, list(linked.unlinked), set()
    (tolerance, needed), size, poses = limits, part_size([capture]), np.array(unconstrained.poses)
    placed = place_groups(capture, poses, linked, limits)
    for v, placement in placed.items():
        poses[v] = placement.T
    alone = [v for v in linked.unlinked if v not in placed]
    core, waiting, several = [*linked.core, *placed], alone, set[int]()
    while waiting:
        surface = surface_of(capture.scans, poses, core, tolerance)
        new = {}
        for v in waiting:
            scan = capture.scans[v]
            if shows_no_surface(scan):
                continue
            starts = [starts_about(model_poses[v], scan, size), model_poses, starts_anywhere(surface, scan)]
            found = place_scan(scan, surface, np.concatenate(starts), size)
            # A part clamped anew lies near: a wide gate would lead past it.
            found += place_scan(scan, surface, model_poses[v][None], _NEAR_GATE * size)
            shared = max(FEW_SHARED, HOLDING / scan.usable.sum())
            closed = closed_placements(scan, [p for p in found if p.near > shared], model_poses, (needed, size))
            own = [p for p in closed if _distances_from_rows(scan, [p], model_poses[v : v + 1])[0] < CLOSE_SHARE * size]
            best = next(iter(own or closed), None)
            several.discard(v)
            if best is not None and not own and has_rival(scan, best, closed, size):
                several.add(v)
            elif best is not None:
                new[v] = best
        if not new:
            break
        for v, placement in new.items():
            poses[v] = placement.T
        placed |= new
        core += list(new)
        waiting = [v for v in waiting if v not in new]
    unsure = {v for v in set(alone) & set(placed) if _placement_is_unsure(capture, linked, model_poses, v, placed[v])}
    return {v: at for v, at in placed.items() if v not in unsure}, sorted([*waiting, *unsure]), several


def _placement_is_unsure(capture: Capture, linked: Linkage, model_poses: Array, view: int, placed: Placement) -> bool:
    """True for a view of a group that was placed alone, and at no row's pose.

    What displaces the views of a group they share: where all of them together closed nowhere, each of them may still
    close where the part looks alike.
    """
    in_group = any(view in group and len(group) > 1 for group in linked.components[1:])
    far = _distances_from_rows(capture.scans[view], [placed], model_poses)[0] > CLOSE_SHARE * part_size([capture])
    return in_group and far


def closed_placements(
    scan: Scan, found: Sequence[Placement], model_poses: Array, limits: tuple[float, float]
) -> list[Placement]:
    """Return the placements that close, the nearest to any row's pose first."""
    needed, size = limits
    away = _distances_from_rows(scan, found, model_poses)
    limit = [needed * (_CLOSURE_AT_ROW if a < CLOSE_SHARE * size else 1.0) for a in away]
    closed = [i for i, p in enumerate(found) if p.closure > limit[i]]
    return [found[i] for i in sorted(closed, key=lambda i: away[i])]


def has_rival(scan: Scan, best: Placement, closed: Sequence[Placement], size: float) -> bool:
    """True if another placement elsewhere is about as good as the best one, wherever the rows' poses are."""
    elsewhere = [p for p in closed if _distances_from_rows(scan, [p], best.T[None])[0] > CLOSE_SHARE * size]
    return any(p.surface_share > _AS_GOOD * best.surface_share for p in elsewhere)


def _distances_from_rows(scan: Scan, found: Sequence[Placement], model_poses: Array) -> list[float]:
    """Return how far each placement is from the nearest row's pose, rms of the points."""
    points = scan.points[::50]
    rows = frames.transform(model_poses, points)
    return [float(np.sqrt(((rows - frames.transform(p.T, points)) ** 2).sum(axis=2).mean(axis=1)).min()) for p in found]
