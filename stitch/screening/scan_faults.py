"""Find faults of single scans: occluders, static background, mirrored or scaled clouds, copies of other scans."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.numerics import frames
from stitch.numerics.distributions import tukey
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.matching import sample_points
from stitch.screening.hypotheses import UNITS
from stitch.screening.placement import ReferenceSurface, evaluate_placement, place_scan, points_in_place, starts_about
from stitch.screening.problems import list_views
from stitch.session.capture import Capture
from stitch.session.scan import Scan, prepare_scan

# Points of a scan that are asked, and other scans, evenly over the session, that are asked for each.
_OCCLUDER_PROBES, _OCCLUDER_VIEWS_COMPARED = 400, 20
# Of the part's size: what is farther from a scan's points it does not show, and what it sees farther behind it looks
# through. Where poses err or an edge is seen aslant, scans differ by less; so do those whose points lie as far apart.
_APART, _SPACINGS = 0.03, 2.0
# Nearest looks of another scan that must all pass a point.
_LOOK_DIRECTIONS = 8
# Share of a scan's points that is worth a word, and how many; scans of good sessions had 0.0025 at the most.
_OCCLUDER_MIN_SHARE, _FEWEST = 0.01, 5


@dataclass(frozen=True)
class Occluder:
    """Points of some scans that stand where others see through: a cable, an arm, a box that stood there for a while."""

    views: tuple[int, ...]
    share: float  # of the points of these views, at least: where no other scan looks, nobody can say

    def describe(self, names: Sequence[str]) -> str:
        """Return a warning with what to do."""
        where, verb = list_views([names[v] for v in self.views], names), "shows" if len(self.views) == 1 else "show"
        return (
            f"At least {self.share:.0%} of what {where} {verb} stands where other scans see through: a cable, an "
            "arm, a clamp or stray points. The stitched cloud leaves out what several scans see through, and may hold "
            "the rest of it; to fix: cut it out, or scan again."
        )


def ray_tree(scan: Scan) -> KDTree:
    """Return the search tree over the directions in which a scan sees its points."""
    return KDTree(scan.rays(scan.points))


def find_occluder(scans: Sequence[Scan], poses: Array, size: float) -> Occluder | None:
    """Return what single scans show where others look through and see nothing; None if it is too little.

    It belongs neither to the part nor to the scanner.

    Args:
        poses: (V, 4, 4) T_reference_scanner where surfaces put the views.
        size: of the part, length_unit.
    """
    views = [v for v, scan in enumerate(scans) if len(scan.points)]
    # Most scans are never asked.
    look_into = cache(lambda w: ray_tree(scans[w]))
    shares = {}
    for v in views:
        asked = _evenly([w for w in views if w != v], _OCCLUDER_VIEWS_COMPARED)
        points = scans[v].points[sample_points(scans[v], _OCCLUDER_PROBES)]
        seen_from = {w: frames.inverse(poses[w]) @ poses[v] for w in asked}
        apart = {w: max(_APART * size, _SPACINGS * scans[w].spacing) for w in asked}
        # Most are shown by the first scans that are asked; only the rest can be in the way.
        alone, count = points, len(points)
        for w in asked:
            there = np.ascontiguousarray(frames.transform(seen_from[w], alone))
            if len(alone):
                shown, _ = scans[w].tree.query(there, k=1, distance_upper_bound=apart[w])
                alone = alone[shown >= apart[w]]
        through = np.zeros(len(alone), bool)
        for w in asked if len(alone) >= _FEWEST else ():
            there = np.ascontiguousarray(frames.transform(seen_from[w], alone))
            through |= _looks_through(scans[w], look_into(w), there, apart[w])
        shares[v] = through.sum() / count if through.sum() >= _FEWEST else 0.0
    found = tuple(v for v, share in shares.items() if share > _OCCLUDER_MIN_SHARE)
    return Occluder(found, float(np.mean([shares[v] for v in found]))) if found else None


def _evenly(views: Sequence[int], count: int) -> list[int]:
    """Return so many of some views at most, all over the list."""
    return [int(views[i]) for i in np.linspace(0, len(views) - 1, min(len(views), count)).astype(int)]


def _looks_through(scan: Scan, look: KDTree, points: Array, behind: float) -> Mask:
    """(n,) points in the frame of a scan all about whose direction what it sees is farther away.

    One look alone would pass an edge beside which it sees nearer: a face that the scan sees from its side stands there.
    Where that face is too steep to be seen, there are looks on one side of the point alone.
    """
    away, rays = np.linalg.norm(points - scan.eye, axis=1), scan.rays(points)
    reach = _SPACINGS * scan.spacing / np.maximum(away, 1e-300)
    through = look.query(rays, k=1, distance_upper_bound=float(reach.max()))[0] < reach
    asked = np.flatnonzero(through)
    if len(asked):
        _, partners = look.query(rays[asked], k=min(_LOOK_DIRECTIONS, len(scan.points)))
        found = scan.points[partners.reshape(len(asked), -1).astype(int)]
        seen = np.linalg.norm(found - scan.eye, axis=2).min(axis=1)
        looks = scan.rays(found.reshape(-1, 3)).reshape(found.shape)
        through[asked] = (seen > away[asked] + behind) & _surrounded(rays[asked], looks)
    return np.asarray(through)


def _surrounded(rays: Array, looks: Array) -> Mask:
    """(n,) which unit vectors (n, 3) have some of others (n, k, 3) on every side: in each half of the directions."""
    across = np.linalg.svd(rays[:, None, :])[2][:, 1:]  # (n, 2, 3) perpendicular to each
    off = np.einsum("nij,nkj->nki", across, looks - rays[:, None])
    angles = np.sort(np.arctan2(off[..., 1], off[..., 0]), axis=1)
    gaps = np.diff(angles, axis=1, append=angles[:, :1] + 2 * np.pi)
    return np.asarray(gaps.max(axis=1, initial=0.0) < np.pi)


# Points of a scan that are asked, other scans in which they are sought, and how many of these must move them, by what
# share of the part's size.
_BACKGROUND_PROBES, _BACKGROUND_VIEWS_COMPARED, _LEAST, _MOVED = 200, 12, 3, 0.1
# Share of the scans' points that is worth a word. Where one of these is looked through under the model it is not on the
# part, where another shows it there it is: so many must be looked through, and 20 to 1.
_BACKGROUND_MIN_SHARE, _THROUGH, _ODDS = 0.01, 5, 20.0
# Of the part's size between it and what stands still, so that a box can part them.
_GAP = 0.02
# Behind a point is farther than so many spacings.
_BEHIND = 4.0


@dataclass(frozen=True)
class StaticBackground:
    """Points at one place before the scanner in all views: a wall, a table, a bracket."""

    share: float  # of the points of all scans
    views: tuple[int, ...]  # that show it
    box: Array  # (2, 3) lowest and highest corner, scanner frame
    within: Array | None  # (2, 3) corners of a box with the part and without it, where one side of a box parts them

    def describe(self, length_unit: str) -> str:
        """Return a warning with what to do."""
        sides = (f"{axis} {low:.4g} to {high:.4g}" for axis, low, high in zip("xyz", *self.box, strict=True))
        fix = f"cut {', '.join(sides)} {length_unit} out of the scans"
        if self.within is not None:
            low, high = (", ".join(f"{side:.4g}" for side in corner) for corner in self.within)
            fix = f"state within = [[{low}], [{high}]] under [scanner] in session.toml"
        return (
            f"{self.share:.0%} of what the scans show stands still before the scanner: a wall, a table or a bracket. "
            f"{len(self.views)} views show it, each elsewhere on the part. The stitched cloud leaves out what other "
            f"views look through, and may hold the rest of it; to fix: {fix}, and run again."
        )


def find_static_background(
    scans: Sequence[Scan], poses: Array, tolerance: float, size: float
) -> StaticBackground | None:
    """Return what the scans show at one place before the scanner whatever the arm did; None if it is too little.

    Where scanner or part are carried around, what belongs to the part changes its place before the scanner with every
    view. What does not belongs to the scanner, and every view puts it elsewhere in the stitched cloud. A panel that
    slides along itself, or a disc that turns about its axis, looks as if it stood still too; but under the model others
    show it where it is, and nobody looks through it.

    Args:
        poses: (V, 4, 4) T_reference_scanner under the model.
        tolerance: distance along the normal that is the same place, length_unit.
        size: of the part, length_unit.
    """
    probes = [sample_points(scan, _BACKGROUND_PROBES) for scan in scans]
    points = [scan.points[own] for scan, own in zip(scans, probes, strict=True)]
    others = [[scans[w] for w in _views_moving_points(own, poses, v, size)] for v, own in enumerate(points)]
    stays = [_static_points(scan, own, far, tolerance) for scan, own, far in zip(scans, probes, others, strict=True)]
    still = np.concatenate(stays)
    if still.mean() < _BACKGROUND_MIN_SHARE:
        return None
    looks = [ray_tree(scan) for scan in scans]
    judged = [_under_model(scans, looks, poses, (v, own), tolerance) for v, own in enumerate(probes)]
    on_part, through = (np.concatenate([found[i] for found in judged]) for i in range(2))
    if np.sum(still & through & ~on_part) < max(_THROUGH, _ODDS * np.sum(still & on_part)):
        return None
    every = np.concatenate(points)
    return StaticBackground(
        share=float(np.mean(still & ~on_part)),
        views=tuple(v for v, own in enumerate(stays) if own.any()),
        box=_bounding_box(every[still & ~on_part]),
        within=_box_beyond_part(every[on_part & ~still], every[still & ~on_part], _bounding_box(every), size),
    )


# A point stands still if so many of the other scans have it, within so many spacings and sigmas of their surface; it
# moves if so few have it. A scene stands still if most points do.
_STANDS, _MOVES, _BESIDE, _ACROSS = 0.6, 0.3, 2.0, 4.0
_MOSTLY, _SEEN_TO_MOVE, _SELDOM = 0.5, 20, 0.25


def find_standing_scene(scans: Sequence[Scan]) -> tuple[float, Array] | None:
    """Return the share of points that stand still before the scanner, and the corners (2, 3) of a box without them.

    Nothing of poses is asked. None where less than half stands still, or no side of a box parts it from what moves.
    """
    probes = [scan.points[sample_points(scan, _BACKGROUND_PROBES)] for scan in scans]
    chosen = np.unique(np.linspace(0, len(scans) - 1, min(len(scans), _BACKGROUND_VIEWS_COMPARED)).round().astype(int))
    found = []
    for v, own in enumerate(probes):
        hits = []
        for scan in (scans[w] for w in chosen if w != v):
            distance, index = scan.tree.query(own)
            across = np.abs(np.einsum("ij,ij->i", own - scan.points[index], scan.normals[index]))
            hits.append((distance < _BESIDE * scan.spacing) & (across < _ACROSS * scan.noise))
        found.append(np.mean(hits, axis=0))
    seen, every = np.concatenate(found), np.concatenate(probes)
    still, moving = every[seen >= _STANDS], every[seen < _MOVES]
    if len(still) < _MOSTLY * len(every) or len(moving) < _SEEN_TO_MOVE:
        return None
    # Of what stands still some is seen seldom: at the rim, and in the shadow of the part.
    moving, still = (
        np.clip(points, *np.quantile(points, (cut, 1 - cut), axis=0))
        for points, cut in ((moving, _SELDOM), (still, _SELDOM / 10))
    )
    size = float(np.linalg.norm(np.ptp(moving, axis=0)))
    box = _box_beyond_part(moving, still, _bounding_box(every), size)
    return None if box is None else (len(still) / len(every), box)


def _bounding_box(points: Array) -> Array:
    return np.array([points.min(axis=0), points.max(axis=0)])


def _box_beyond_part(part: Array, other: Array, every: Array, size: float) -> Array | None:
    """(2, 3) the box of everything, widened, less what lies beyond the side that parts best."""
    out = every + size * np.array([[-1.0], [1.0]])
    if not len(part):
        return None
    (low, high), (other_low, other_high) = _bounding_box(part), _bounding_box(other)
    gaps = np.array([low - other_high, other_low - high])
    side, axis = np.unravel_index(gaps.argmax(), gaps.shape)
    if gaps[side, axis] < _GAP * size:
        return None
    # Nearer to what stands still: between the probes the part may reach farther.
    near, far = (low[axis], other_high[axis]) if side == 0 else (high[axis], other_low[axis])
    out[side, axis] = 0.2 * near + 0.8 * far
    return np.asarray(out)


def _views_moving_points(points: Array, poses: Array, v: int, size: float) -> list[int]:
    """Return views between which and view v the model moves its points before the scanner, all over the session."""
    if not len(points):
        return []
    there = frames.transform(frames.inverse(poses) @ poses[v], points[None])
    far = np.flatnonzero(np.median(np.linalg.norm(there - points, axis=2), axis=1) > _MOVED * size)
    return _evenly(far.tolist(), _BACKGROUND_VIEWS_COMPARED)


def _static_points(scan: Scan, own: Indices, others: Sequence[Scan], tolerance: float) -> Mask:
    """(n,) points that most of the others show at the same place before the scanner."""
    if len(others) < _LEAST:
        return np.zeros(len(own), bool)
    points, normals = scan.points[own], scan.normals[own]
    return np.asarray(np.mean([points_in_place(other, points, normals, tolerance) for other in others], axis=0) > 0.5)


def _under_model(
    scans: Sequence[Scan], looks: Sequence[KDTree], poses: Array, probes: tuple[int, Indices], tolerance: float
) -> tuple[Mask, Mask]:
    """(n,) (n,) points of a view that another shows where the model has them, and that another looks through there."""
    v, own = probes
    on_part, through = np.zeros(len(own), bool), np.zeros(len(own), bool)
    for w, scan in enumerate(scans):
        if w == v or not len(own):
            continue
        T_w_v = frames.inverse(poses[w]) @ poses[v]
        points = frames.transform(T_w_v, scans[v].points[own])
        normals = frames.rotate(T_w_v, scans[v].normals[own])
        on_part |= points_in_place(scan, points, normals, tolerance)
        away = np.linalg.norm(points - scan.eye, axis=1)
        beside, partner = looks[w].query(scan.rays(points), k=1)
        hit = beside * away < 2 * scan.spacing
        seen = np.linalg.norm(scan.points[partner.astype(int)] - scan.eye, axis=1)
        through |= hit & (seen > away + _BEHIND * scan.spacing)
    return on_part, through


# Reflections of the scanner frame, with what was done.
_FLIPS = {
    "x has the wrong sign": np.diag([-1.0, 1, 1]),
    "y has the wrong sign": np.diag([1.0, -1, 1]),
    "z has the wrong sign": np.diag([1.0, 1, -1]),
    "x and y are exchanged": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]),
    "y and z are exchanged": np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "x and z are exchanged": np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]]),
}
# Factors that are looked for; nearer to one than the last, scanners differ from robots.
_LEAST_SCALE, _NEAR_ONE = 0.5, 1e-3
# Of the part's size: how far a scan may be moved whose pose is right.
_STAYS = 0.03
# Of the shift that a scale makes along the ray, the share that its own uncertainty may leave.
_RANGE_LEFT = 0.3


@dataclass(frozen=True)
class ScanFault:
    """A scan that closes on the others once this is undone."""

    kind: str  # mirrored | scale | unit
    fix: str


def scan_fault(scan: Scan, T_pose: Array, surface: ReferenceSurface, size: float, needed: float) -> ScanFault | None:
    """Return what makes a scan close on the surface of the others, at its pose or near it; None if nothing does.

    Args:
        T_pose: (4, 4) T_reference_scanner from the robot.
        size: of the part, length_unit.
        needed: closure that counts as closed.
    """

    def closes(points: Array, eye: Array, reach: float) -> float:
        other = prepare_scan(scan.name, points, eye=eye)
        placed = place_scan(other, surface, starts_about(T_pose, other, size), size)[0]
        found = (evaluate_placement(other, T_pose, surface), placed)
        return max(f.closure if f.near > 0.3 and _moved(other, T_pose, f.T) < reach else 0.0 for f in found)

    # The pose of a mirrored scan is right: on a part that looks alike in a mirror, others close elsewhere too.
    near = _STAYS * size
    mirrored = [w for w, flip in _FLIPS.items() if closes(scan.points @ flip, scan.eye @ flip, near) > needed]
    if len(mirrored) == 1:
        return ScanFault("mirrored", f"{mirrored[0]} in this cloud; to fix: export it again")
    for factor, words in UNITS.items():
        if closes(scan.points / factor, scan.eye / factor, np.inf) > needed:
            return ScanFault(
                "unit", f"this cloud is {factor:.6g} times too large ({words}); to fix: export it in the right unit"
            )
    return scale_fault(scan, T_pose, surface, size, needed)


def scale_fault(scan: Scan, T_pose: Array, surface: ReferenceSurface, size: float, needed: float) -> ScanFault | None:
    """Return a factor on the cloud under which it closes at its own pose; None if there is none."""
    begin = place_scan(scan, surface, np.concatenate([T_pose[None], starts_about(T_pose, scan, size)]), size)[0]
    scale = _similarity(scan, begin.T, surface, size)
    if not (_LEAST_SCALE < scale < 1 / _LEAST_SCALE) or abs(scale - 1) < _NEAR_ONE:
        return None
    other = prepare_scan(scan.name, scan.points * scale, eye=scan.eye * scale)
    found = evaluate_placement(other, T_pose, surface)
    if found.closure < needed:
        # The factor from the shape is good to a thousandth; the range that it leaves is one of millimetres.
        found = place_scan(other, surface, T_pose[None], 0.2 * size)[0]
        allowed = _RANGE_LEFT * abs(scale - 1) * np.linalg.norm(other.points.mean(axis=0))
        if found.closure < needed or _moved(other, T_pose, found.T) > allowed:
            return None
    size_text = f"this cloud is {1 / scale:.4g} times as large as the part"
    return ScanFault("scale", f"{size_text}; to fix: multiply it by {scale:.5g}")


def _moved(scan: Scan, T: Array, other: Array) -> float:
    """Return how far apart two poses put the middle of a scan."""
    middle = scan.points.mean(axis=0)[None]
    return float(np.linalg.norm(frames.transform(other, middle) - frames.transform(T, middle)))


def _similarity(scan: Scan, T: Array, surface: ReferenceSurface, size: float) -> float:
    """Fit a factor on the scan's points to a surface, with its pose: point-to-plane, seven unknowns."""
    index = sample_points(scan, 600)
    points, normals = scan.points[index], scan.normals[index]
    centre, scale = points.mean(axis=0), 1.0
    lever = float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean()))
    for gate in np.maximum(size * np.geomspace(0.1, 0.01, 25), 1.5 * surface.spacing):
        shown = centre + scale * (points - centre)
        residual, normal, found, _ = (x[0] for x in surface.meets(T[None], shown, normals, gate))
        arm = frames.transform(T, shown) - frames.transform(T, centre[None])
        along = np.einsum("nj,nj->n", arm, normal)[:, None] / lever
        J = np.concatenate([np.cross(arm, normal) / lever, normal, along], axis=1)
        spread = 1.4826 * np.median(np.abs(residual[found])) if found.any() else gate
        weight = found * tukey(residual, max(spread, surface.tolerance / 4))
        H = J.T @ (weight[:, None] * J)
        step = -np.linalg.solve(H + 1e-6 * (np.trace(H) + 1e-9) * np.eye(7), J.T @ (weight * residual))
        step[[0, 1, 2, 6]] /= lever
        to = frames.make(np.eye(3), -frames.transform(T, centre[None])[0])
        T = frames.inverse(to) @ frames.exp(step[:6]) @ to @ T
        scale *= 1 + float(step[6])
    return scale


def find_copies(capture: Capture) -> list[tuple[int, int]]:
    """Find pairs of views (v < w) that show the same measured points."""
    return [(v, w) for (v, a), (w, b) in combinations(enumerate(capture.scans), 2) if _same_points(a, b)]


def _same_points(a: Scan, b: Scan) -> bool:
    """True if nearly every point of `a` is found in `b`, far closer than two measurements ever agree."""
    if abs(len(a.points) - len(b.points)) > 0.02 * max(len(a.points), len(b.points)):
        return False
    index = np.linspace(0, len(a.points) - 1, min(len(a.points), 60)).astype(int)
    distance, _ = b.tree.query(np.ascontiguousarray(a.points[index]), k=1)
    return bool(np.mean(distance < 1e-4 * b.spacing) > 0.9)


def find_same_poses(capture: Capture) -> list[tuple[int, int]]:
    """Find pairs of views (v < w) with the very same pose."""
    T = capture.T_reference_mount
    return [(v, w) for v, w in combinations(range(len(T)), 2) if np.allclose(T[v], T[w], rtol=0, atol=1e-9)]
