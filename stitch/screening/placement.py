"""Find where a scan belongs among the others, tried wide: from many starts, by the surface alone.

Point-to-plane ICP (Chen & Medioni 1992) of one scan against the surface of other views, all starts at once, with a
gate that shrinks. A placement is judged by its closure: of the points that come to lie near the other surface, the
share that lies on it.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pykdtree.kdtree import KDTree
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.numerics.distributions import MAD_TO_SIGMA
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.screening.linkage import HOLDING, Linkage
from stitch.session.capture import Capture, part_size
from stitch.session.scan import Scan

# Points of the other views that make up their surface, and of the scan that is placed.
_SURFACE_POINTS = 30_000
_COARSE_PROBES, _JUDGED_PROBES, _FINAL_PROBES = 160, 300, 600
_NORMAL_COSINE = np.cos(np.radians(45.0))
# Gates of the search as shares of the size: from a third of the part to a two-hundredth.
_FIRST_GATE, _LAST_GATE, _STEPS = 0.35, 0.005, 14
_FINAL_STEPS = 15
_KEPT = 4
# Starts: turns about each axis beside a pose, directions, and turns anywhere.
_START_TURN = np.radians(12)
_AXES = np.vstack([np.eye(3), -np.eye(3)])
_TURNS_ANYWHERE = 48
# A scan of a line or of a point has no second direction: its extent there, as a share of the largest.
_LINE = 1e-3
_FEWEST = 30
# Points of a scan that stand for it: every so many.
_EVERY = 50
# Points of each view that stand for it in its group.
_GROUP_PROBES = 600
# What shows less than this share of the surface cannot be seen to belong there.
FEW_SHARED = 0.1
# A placement is right if at least this share of what linked views have on the others' surface lies on it. Right ones
# have 0.9 to 1 of it, scans of other parts up to 0.35, scaled by 2.5 % up to 0.7.
_ACCEPTED_CLOSURE = 0.8
# A placement at some row's very pose is believed sooner: by chance none lies there. Other parts still do not reach it.
_CLOSURE_AT_ROW = 0.75
CLOSE_SHARE = 0.03  # of the part's size
# Another place is as good as the best one if so large a share of what lies on the surface there does so.
_AS_GOOD = 0.8
_NEAR_GATE = 0.2


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
        """Return, for n points at S poses, the signed distance (S, n), normal (S, n, 3), and two masks (S, n).

        The first mask: the nearest surface point within `gate` faces the same way; the second: there is one at all.
        Distances and normals are those of the surface point, reference frame; arbitrary where there is none.

        Args:
            poses: (S, 4, 4) T_reference_scanner.
            points, normals: (n, 3) scanner frame.
            gate: length_unit.
        """
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
    """Return the surface that some views show together, as points with normals in the reference frame.

    Args:
        poses: (V, 4, 4) T_reference_scanner of all scans.
        views: numbers of the scans that count.
        tolerance: distance along the normal at which a point lies on the surface, length_unit.
    """
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
    """Return True for a scan of so few points, or of points in one line, that it fits anywhere."""
    return bool(scan.usable.sum() < _FEWEST) or lies_in_a_line(scan)


def lies_in_a_line(scan: Scan) -> bool:
    """Return True for a scan of points in a straight line: on a flat part it lies on the surface, and holds nothing."""
    centred = scan.points - scan.points.mean(axis=0)
    squares = np.linalg.eigvalsh(centred.T @ centred)
    return bool(squares[1] < _LINE**2 * squares[2])


def evaluate_placement(scan: Scan, T: Array, surface: ReferenceSurface) -> Placement:
    """Return how well a scan lies on a surface under a pose (4, 4)."""
    return _evaluate_placements(scan, T[None], surface, _FINAL_PROBES)[0]


def _evaluate_placements(scan: Scan, poses: Array, surface: ReferenceSurface, probes: int) -> list[Placement]:
    """Return per pose (S, 4, 4) the share of a scan's points that lie near a surface, and of these the share on it.

    Args:
        probes: number of points of the scan that are tested.
    """
    index = sample_points(scan, probes)
    if not len(index):
        return [Placement(T, 0.0, 0.0) for T in poses]
    residual, _, meets, near = surface.meets(poses, scan.points[index], scan.normals[index], surface.near)
    on = meets & (np.abs(residual) < surface.tolerance)
    return [
        Placement(T, float(near[i].mean()), float(on[i].sum() / max(near[i].sum(), 1))) for i, T in enumerate(poses)
    ]


def place_scan(scan: Scan, surface: ReferenceSurface, starts: Array, size: float) -> list[Placement]:
    """Return the `_KEPT` best placements of a scan on a surface, by ICP from every start, best first.

    Few points from all starts, with a gate that shrinks; then the best ones with more points. Best is the largest share
    of points on the surface.

    Args:
        starts: (S, 4, 4) T_reference_scanner.
        size: of the part, length_unit: the first gate is a third of it.
    """
    gates = np.maximum(size * np.geomspace(_FIRST_GATE, _LAST_GATE, _STEPS), 1.5 * surface.spacing)
    poses = _icp_scan(scan, surface, starts, gates, _COARSE_PROBES)
    coarse = _evaluate_placements(scan, poses, surface, _JUDGED_PROBES)
    best = sorted(range(len(coarse)), key=lambda i: -coarse[i].surface_share)[:_KEPT]
    poses = _icp_scan(scan, surface, poses[best], np.full(_FINAL_STEPS, gates[-1]), _FINAL_PROBES)
    return sorted(_evaluate_placements(scan, poses, surface, _FINAL_PROBES), key=lambda p: -p.surface_share)


def _icp_scan(scan: Scan, surface: ReferenceSurface, starts: Array, gates: Array, probes: int) -> Array:
    """Return poses (S, 4, 4) of a scan after point-to-plane ICP from every start, one Gauss–Newton step per gate.

    Args:
        starts: (S, 4, 4) T_reference_scanner.
        gates: largest distances between corresponding points, length_unit, one after the other.
        probes: number of points of the scan that are matched.
    """
    index = sample_points(scan, probes)
    points, normals = scan.points[index], scan.normals[index]
    poses = np.array(starts)
    centre = points.mean(axis=0)
    lever = float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean())) or 1.0
    for gate in gates:
        residual, normal, meets, _ = surface.meets(poses, points, normals, gate)
        # Twists about each pose's own centre, rotations in units of the lever: well scaled at every start.
        arm = frames.transform(poses, points) - frames.transform(poses, centre[None])
        J = np.concatenate([np.cross(arm, normal) / lever, normal], axis=2)
        spread = np.median(np.where(meets, np.abs(residual), np.nan_to_num(gate)), axis=1)
        cut = np.maximum(3 * MAD_TO_SIGMA * spread, 2 * surface.tolerance)[:, None]
        weight = meets * np.clip(1 - (residual / np.maximum(cut, 1e-300)) ** 2, 0, None) ** 2
        H = np.einsum("sn,sni,snj->sij", weight, J, J, optimize=True)
        b = np.einsum("sn,sni,sn->si", weight, J, residual, optimize=True)
        H += 1e-4 * (np.trace(H, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(6)
        step = -np.linalg.solve(H, b[..., None])[..., 0]
        step[:, :3] /= lever
        poses = frames.moved_about(frames.transform(poses, centre[None])[:, 0], step, poses)
    return poses


def starts_about(T: Array, scan: Scan, size: float) -> Array:
    """Return a pose T (4, 4) and 12 neighbours, (13, 4, 4): 12° about, and a third of the part along, ± each axis.

    Rotations are about the centroid of the scan.

    Args:
        size: of the part, length_unit.
    """
    centre = frames.transform(T, scan.points.mean(axis=0)[None])[0]
    to = frames.make(np.eye(3), -centre)
    turns = [frames.make(Rotation.from_rotvec(axis * _START_TURN).as_matrix(), np.zeros(3)) for axis in _AXES]
    shifts = [frames.make(np.eye(3), axis * _FIRST_GATE * size) for axis in _AXES]
    return np.array([T] + [frames.inverse(to) @ move @ to @ T for move in (*turns, *shifts)])


def needed_closure(capture: Capture, poses: Array, linked: Linkage, tolerance: float) -> float:
    """Return the closure (share of near points that lie on the surface) from which a scan counts as placed.

    It is `_ACCEPTED_CLOSURE` times the median closure of some linked views at their poses. Where all views are linked,
    or hardly any, it is `_ACCEPTED_CLOSURE` itself.

    Args:
        poses: (V, 4, 4) T_reference_scanner.
        tolerance: distance along the normal at which a point lies on the surface, length_unit.
    """
    core = linked.core
    if not linked.unlinked or len(core) < 2:
        return _ACCEPTED_CLOSURE
    usual = []
    for v in core[:: max(len(core) // 6, 1)]:
        others = surface_of(capture.scans, poses, [w for w in core if w != v], tolerance)
        usual.append(evaluate_placement(capture.scans[v], poses[v], others).closure)
    return _ACCEPTED_CLOSURE * float(np.median(usual))


def place_unlinked_views(
    capture: Capture,
    model_poses: Array,
    unconstrained: UnconstrainedPoses,
    linked: Linkage,
    tolerance: float,
    needed: float,
) -> tuple[dict[int, Placement], list[int], set[int]]:
    """Return the unlinked views that can be placed, those that cannot, and of these the ones that fit several places.

    They are placed on the surface of the core, the largest group of linked views. Other groups are placed first, each
    as a whole, then single views, round by round: those placed join the core, and the others are tried again. On a part
    that looks alike from several sides a view may fit several places: it is not placed unless one of them is the pose
    of its own row in the table. Nor is a view of a group that fits nowhere as a whole, unless it fits at the pose of
    some row: its own, or, where scans were mixed up, another's.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner by the robot.
        unconstrained: the views moved by the overlaps alone.
        tolerance: distance along the normal at which a point lies on the surface, length_unit.
        needed: share (0 to 1) of a scan's points near the surface that have to lie on it, its closure.
    """
    if not linked.unlinked or len(linked.core) < 2:
        return {}, list(linked.unlinked), set()
    placed = place_groups(capture, unconstrained.poses, linked, tolerance, needed)
    alone = [v for v in linked.unlinked if v not in placed]
    poses = np.array(unconstrained.poses)
    for v, placement in placed.items():
        poses[v] = placement.T
    core = [*linked.core, *placed]
    singles, several = _place_singles(capture, model_poses, poses, core, alone, tolerance, needed)
    # The views of a group share their displacement. If the group fits nowhere, a single view that fits somewhere, and
    # not at any row's pose, does so only because the part looks alike there.
    in_groups = {v for group in linked.components[1:] if len(group) > 1 for v in group}
    near = CLOSE_SHARE * part_size([capture])
    unsure = {
        v
        for v, placement in singles.items()
        if v in in_groups and pose_distances(capture.scans[v], placement.T, model_poses).min() > near
    }
    placed |= {v: placement for v, placement in singles.items() if v not in unsure}
    return placed, [v for v in alone if v not in placed], several


def _place_singles(
    capture: Capture,
    model_poses: Array,
    poses: Array,
    core: Sequence[int],
    alone: Sequence[int],
    tolerance: float,
    needed: float,
) -> tuple[dict[int, Placement], set[int]]:
    """Return the placements of single views on the surface of others, and the views that fit several places alike.

    In rounds: those placed join the others, and the rest is tried again, until none is placed.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner by the robot.
        poses: (V, 4, 4) T_reference_scanner of the views whose surface counts at first; others are not read.
        core: numbers of these views.
        alone: numbers of the views to place.
        tolerance: distance along the normal at which a point lies on the surface, length_unit.
        needed: closure from which a scan counts as placed.
    """
    poses, core, waiting = poses.copy(), list(core), list(alone)
    placed, several = dict[int, Placement](), set[int]()
    while waiting:
        surface = surface_of(capture.scans, poses, core, tolerance)
        shown = [v for v in waiting if not shows_no_surface(capture.scans[v])]
        fits = {v: _place_alone(capture, model_poses, v, surface, needed) for v in shown}
        several = {v for v, (best, has_rivals) in fits.items() if best is not None and has_rivals}
        new = {v: best for v, (best, has_rivals) in fits.items() if best is not None and not has_rivals}
        if not new:
            break
        for v, placement in new.items():
            poses[v] = placement.T
        placed |= new
        core += list(new)
        waiting = [v for v in waiting if v not in new]
    return placed, several


def _place_alone(
    capture: Capture, model_poses: Array, view: int, surface: ReferenceSurface, needed: float
) -> tuple[Placement | None, bool]:
    """Return where a single scan fits the surface, None if nowhere, and whether it fits another place about as well.

    A fit at its own row's pose is taken at once, without rivals. Starts: about its row, at all rows, and anywhere.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner of the rows.
        needed: closure from which a scan counts as placed.
    """
    size = part_size([capture])
    scan = capture.scans[view]
    # The scan's centre on the surface's centre, turned every way.
    R = Rotation.random(_TURNS_ANYWHERE, rng=np.random.default_rng(0)).as_matrix()
    anywhere = frames.make(R, surface.points.mean(axis=0) - R @ scan.points.mean(axis=0))
    starts = [starts_about(model_poses[view], scan, size), model_poses, anywhere]
    placements = place_scan(scan, surface, np.concatenate(starts), size)
    # A part clamped anew lies near: a wide gate would lead past it.
    placements += place_scan(scan, surface, model_poses[view][None], _NEAR_GATE * size)
    shared = max(FEW_SHARED, HOLDING / scan.usable.sum())
    closed = closed_placements(scan, [p for p in placements if p.near > shared], model_poses, needed, size)
    row = model_poses[view : view + 1]
    at_row = next((p for p in closed if pose_distances(scan, p.T, row)[0] < CLOSE_SHARE * size), None)
    if at_row is not None or not closed:
        return at_row, False
    return closed[0], has_rival(scan, closed[0], closed, size)


def closed_placements(
    scan: Scan, placements: Sequence[Placement], model_poses: Array, needed: float, size: float
) -> list[Placement]:
    """Return the placements with enough closure, the nearest to any row's pose first.

    At a row's pose less is needed (`_CLOSURE_AT_ROW`), since a wrong placement seldom lies there.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner of the rows.
        needed: closure from which a scan counts as placed.
        size: of the part, length_unit.
    """
    away = [pose_distances(scan, p.T, model_poses).min() for p in placements]
    limit = [needed * (_CLOSURE_AT_ROW if distance < CLOSE_SHARE * size else 1.0) for distance in away]
    closed = [i for i, p in enumerate(placements) if p.closure > limit[i]]
    return [placements[i] for i in sorted(closed, key=lambda i: away[i])]


def has_rival(scan: Scan, best: Placement, closed: Sequence[Placement], size: float) -> bool:
    """Return True if another placement elsewhere is about as good as the best one, wherever the rows' poses are."""
    away = pose_distances(scan, best.T, np.array([p.T for p in closed]))
    elsewhere = [p for p, distance in zip(closed, away, strict=True) if distance > CLOSE_SHARE * size]
    return any(p.surface_share > _AS_GOOD * best.surface_share for p in elsewhere)


def pose_distances(scan: Scan, T: Array, poses: Array) -> Array:
    """Return (P,) the rms distance, length_unit, between a scan's points at one pose (4, 4) and at others (P, 4, 4)."""
    points = scan.points[::_EVERY]
    return np.sqrt(((frames.transform(poses, points) - frames.transform(T, points)) ** 2).sum(axis=2).mean(axis=1))


def place_groups(
    capture: Capture, poses: Array, linked: Linkage, tolerance: float, needed: float
) -> dict[int, Placement]:
    """Return the placements of the views in groups outside the core, each group moved as one body.

    The views of a group share their displacement: together they show more of the others' surface than each alone. A
    group that is placed joins the core; one that fits nowhere is left out.

    Args:
        poses: (V, 4, 4) T_reference_scanner at which the views of each group fit together.
        tolerance: distance along the normal at which a point lies on the surface, length_unit.
        needed: closure from which a group counts as placed.
    """
    size = part_size([capture])
    core = list(linked.core)
    placed = dict[int, Placement]()
    for group in (part for part in linked.components[1:] if len(part) > 1):
        surface = surface_of(capture.scans, poses, core, tolerance)
        scan = _merge_scans(capture.scans, poses, group)
        placements = place_scan(scan, surface, starts_about(np.eye(4), scan, size), size)
        closed = [p for p in placements if _group_closes(scan, p.T, surface, needed)]
        if not closed:
            continue
        # A part may look alike from several sides: of the places in which the group closes, the nearest.
        T = min(closed, key=lambda p: float(np.sum((frames.transform(p.T, scan.points) - scan.points) ** 2))).T
        placed |= {v: evaluate_placement(capture.scans[v], T @ poses[v], surface) for v in group}
        core += group
        poses = np.array([T @ pose if v in group else pose for v, pose in enumerate(poses)])
    return placed


def _merge_scans(scans: Sequence[Scan], poses: Array, group: Sequence[int]) -> Scan:
    """Return some points of all views of a group as one scan, whose frame is the reference frame."""
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
    """Return True if enough of what faces the surface lies on it.

    Halves of a session may show the two sides of a thin wall: there what is near and faces the other way says nothing.
    """
    residual, _, meets, _ = surface.meets(T[None], scan.points, scan.normals, surface.near)
    on = meets & (np.abs(residual) < surface.tolerance)
    return bool(meets.mean() > FEW_SHARED and on.sum() > needed * meets.sum())
