"""Find what scans show beside the part: what stands still before the scanner, and what is in the way of other scans.

A wall, a table or the scanner's own bracket belongs to the scanner: it stands at one place before it whatever the arm
did. A cable, a clamp or an operator's arm belongs to nothing: it stands where other scans look through.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.matching import sample_points
from stitch.screening.linkage import points_in_place
from stitch.session.scan import Scan, even_indices

# Points of a scan that are asked whether they are in the way, and other scans, all over the session, asked for each.
_OCCLUDER_PROBES, _OCCLUDER_VIEWS = 400, 20
# Of the part's size: what is farther from a scan's points it does not show, and what it sees farther behind it looks
# through. Where poses err or an edge is seen aslant, scans differ by less; so do those whose points lie as far apart.
_APART, _SPACINGS = 0.03, 2.0
# Nearest looks of another scan that must all pass a point.
_LOOK_DIRECTIONS = 8
# Share of a scan's points that is worth a word, and how many; scans of good sessions had 0.0025 at the most.
_OCCLUDER_MIN_SHARE, _FEWEST = 0.01, 5
# Points of a scan that are asked whether they stand still, other scans in which they are sought, and how many of these
# must move them, by what share of the part's size.
_BACKGROUND_PROBES, _BACKGROUND_VIEWS, _LEAST, _MOVED = 200, 12, 3, 0.1
# Share of the scans' points that is worth a word. Where one of these is looked through under the model it is not on the
# part, where another shows it there it is: so many must be looked through, and 20 to 1.
_BACKGROUND_MIN_SHARE, _THROUGH, _ODDS = 0.01, 5, 20.0
# Of the part's size between it and what stands still, so that a box can part them.
_GAP = 0.02
# Behind a point is farther than so many spacings.
_BEHIND = 4.0
# Without a model: a point stands still if so many of the other scans have it, within so many spacings and sigmas of
# their surface; it moves if so few have it. A scene stands still if most points do.
_STANDS, _MOVES, _BESIDE, _ACROSS = 0.6, 0.3, 2.0, 4.0
_MOSTLY, _SEEN_TO_MOVE, _SELDOM = 0.5, 20, 0.25


def find_occluder(scans: Sequence[Scan], poses: Array, size: float) -> tuple[tuple[int, ...], float] | None:
    """Return the views that show something where other scans look through, and the mean share of their points there.

    None where no view has more than `_OCCLUDER_MIN_SHARE`. Of each view some points are tested: those that no other
    scan shows, and behind which one measured a surface. The share is a lower bound: others do not look everywhere.

    Args:
        poses: (V, 4, 4) T_reference_scanner where the overlaps put the views.
        size: of the part, length_unit.
    """
    views = [v for v, scan in enumerate(scans) if len(scan.points)]
    # A tree is built only for scans that are needed: most are not.
    ray_tree_of = cache(lambda w: _ray_tree(scans[w]))
    shares = {}
    for v in views:
        others = [w for w in views if w != v]
        sample = [others[i] for i in even_indices(len(others), _OCCLUDER_VIEWS)]
        points = scans[v].points[sample_points(scans[v], _OCCLUDER_PROBES)]
        seen_from = {w: frames.inverse(poses[w]) @ poses[v] for w in sample}
        clearance = {w: max(_APART * size, _SPACINGS * scans[w].spacing) for w in sample}
        # Points that no other scan shows: most drop out with the first scans.
        alone = points
        for w in sample:
            in_other = np.ascontiguousarray(frames.transform(seen_from[w], alone))
            if len(alone):
                distance, _ = scans[w].tree.query(in_other, k=1, distance_upper_bound=clearance[w])
                alone = alone[distance >= clearance[w]]
        is_looked_through = np.zeros(len(alone), bool)
        for w in sample if len(alone) >= _FEWEST else ():
            in_other = np.ascontiguousarray(frames.transform(seen_from[w], alone))
            is_looked_through |= _looks_through(scans[w], ray_tree_of(w), in_other, clearance[w])
        count = is_looked_through.sum()
        shares[v] = count / len(points) if count >= _FEWEST else 0.0
    showing = tuple(v for v, share in shares.items() if share > _OCCLUDER_MIN_SHARE)
    return (showing, float(np.mean([shares[v] for v in showing]))) if showing else None


def _ray_tree(scan: Scan) -> KDTree:
    """Return the search tree over the directions in which a scan sees its points."""
    return KDTree(scan.rays(scan.points))


def _looks_through(scan: Scan, look: KDTree, points: Array, behind: float) -> Mask:
    """Return a mask (n,) of the points that a scan looks past: in every direction around their rays it saw farther.

    Rays around are asked, not the nearest alone: beside an edge that one may pass a face that the scan sees aslant. If
    the face is too steep to be seen, there are rays on one side of the point only (`_surrounded`).

    Args:
        look: tree over the directions of the scan's points.
        points: (n, 3) frame of the scan.
        behind: least distance from a point to what lies behind it, length_unit.
    """
    away = np.linalg.norm(points - scan.eye, axis=1)
    rays = scan.rays(points)
    reach = _SPACINGS * scan.spacing / np.maximum(away, 1e-300)
    through = look.query(rays, k=1, distance_upper_bound=float(reach.max()))[0] < reach
    asked = np.flatnonzero(through)
    if len(asked):
        _, partners = look.query(rays[asked], k=min(_LOOK_DIRECTIONS, len(scan.points)))
        near = scan.points[partners.reshape(len(asked), -1).astype(int)]
        seen = np.linalg.norm(near - scan.eye, axis=2).min(axis=1)
        looks = scan.rays(near.reshape(-1, 3)).reshape(near.shape)
        through[asked] = (seen > away[asked] + behind) & _surrounded(rays[asked], looks)
    return through


def _surrounded(rays: Array, looks: Array) -> Mask:
    """Return a mask (n,) of rays with other rays on every side: no gap of half a turn or more around them.

    Args:
        rays: (n, 3) unit vectors.
        looks: (n, k, 3) unit vectors near each.
    """
    across = np.linalg.svd(rays[:, None, :])[2][:, 1:]  # (n, 2, 3) perpendicular to each
    off = np.einsum("nij,nkj->nki", across, looks - rays[:, None])
    angles = np.sort(np.arctan2(off[..., 1], off[..., 0]), axis=1)
    gaps = np.diff(angles, axis=1, append=angles[:, :1] + 2 * np.pi)
    return gaps.max(axis=1, initial=0.0) < np.pi


def find_static_background(
    scans: Sequence[Scan], poses: Array, tolerance: float, size: float
) -> tuple[float, tuple[int, ...], Array, Array | None] | None:
    """Return what stands still before the scanner whatever the arm did; None if it is too little.

    A point stands still if most views whose pose moves it show it at the same place before the scanner. A panel that
    slides along itself, or a disc that turns about its axis, does so too; but under the model other views show it where
    it is and none looks through it, so that it is no background.

    Args:
        poses: (V, 4, 4) T_reference_scanner under the model.
        tolerance: distance along the normal that is the same place, length_unit.
        size: of the part, length_unit.

    Returns:
        Its share of all points; the views that show it; the box (2, 3) around it, two corners, scanner frame; and a box
        with the part and without it, None where no axis-parallel plane parts the two.
    """
    probes = [sample_points(scan, _BACKGROUND_PROBES) for scan in scans]
    points = [scan.points[index] for scan, index in zip(scans, probes, strict=True)]
    stays = []
    for v, scan in enumerate(scans):
        # Points that most of the others show at the same place before the scanner.
        others = [scans[w] for w in _views_moving_points(points[v], poses, v, size)]
        normals = scan.normals[probes[v]]
        shows_it = [points_in_place(other, points[v], normals, tolerance) for other in others]
        stays.append(np.mean(shows_it, axis=0) > 0.5 if len(others) >= _LEAST else np.zeros(len(points[v]), bool))
    still = np.concatenate(stays)
    if still.mean() < _BACKGROUND_MIN_SHARE:
        return None
    looks = [_ray_tree(scan) for scan in scans]
    judged = [_under_model(scans, looks, poses, v, index, tolerance) for v, index in enumerate(probes)]
    on_part = np.concatenate([in_place for in_place, _ in judged])
    through = np.concatenate([looked_through for _, looked_through in judged])
    if np.sum(still & through & ~on_part) < max(_THROUGH, _ODDS * np.sum(still & on_part)):
        return None
    every = np.concatenate(points)
    views = tuple(v for v, mask in enumerate(stays) if mask.any())
    background = every[still & ~on_part]
    within = _box_beyond_part(every[on_part & ~still], background, _bounding_box(every), size)
    return float(np.mean(still & ~on_part)), views, _bounding_box(background), within


def _views_moving_points(points: Array, poses: Array, v: int, size: float) -> list[int]:
    """Return some views whose scanners, by the model, have the points of view v far from where scanner v has them.

    Only in these does a point at the same place before the scanner mean that it stands still.

    Args:
        points: (n, 3) of view v, scanner frame.
        poses: (V, 4, 4) T_reference_scanner by the model.
        size: of the part, length_unit: a share of it is far enough.
    """
    if not len(points):
        return []
    in_others = frames.transform(frames.inverse(poses) @ poses[v], points[None])
    far = np.flatnonzero(np.median(np.linalg.norm(in_others - points, axis=2), axis=1) > _MOVED * size)
    return far[even_indices(len(far), _BACKGROUND_VIEWS)].tolist()


def _under_model(
    scans: Sequence[Scan], looks: Sequence[KDTree], poses: Array, v: int, index: Indices, tolerance: float
) -> tuple[Mask, Mask]:
    """Return two masks (n,) of some points of a view: another view shows it at its place, another view looks past it.

    Args:
        looks: per view a tree over the directions of its points.
        poses: (V, 4, 4) T_reference_scanner by the model.
        v: number of the view.
        index: numbers (n,) of its points to test.
        tolerance: distance along the normal that is the same place, length_unit.
    """
    on_part = np.zeros(len(index), bool)
    through = np.zeros(len(index), bool)
    for w, scan in enumerate(scans):
        if w == v or not len(index):
            continue
        T_w_v = frames.inverse(poses[w]) @ poses[v]
        points = frames.transform(T_w_v, scans[v].points[index])
        normals = frames.rotate(T_w_v, scans[v].normals[index])
        on_part |= points_in_place(scan, points, normals, tolerance)
        through |= _looks_through(scan, looks[w], points, _BEHIND * scan.spacing)
    return on_part, through


def find_standing_scene(scans: Sequence[Scan]) -> tuple[float, Array] | None:
    """Return the share of points that stand still before the scanner, and a box (2, 3), scanner frame, without them.

    It needs no poses: a point stands still if most other scans show it at the same place in their own frame. None where
    less than half of the points do, or where no axis-parallel plane separates them from those that move.
    """
    probes = [scan.points[sample_points(scan, _BACKGROUND_PROBES)] for scan in scans]
    chosen = np.unique(np.linspace(0, len(scans) - 1, min(len(scans), _BACKGROUND_VIEWS)).round().astype(int))
    shares = []
    for v, points in enumerate(probes):
        hits = []
        for scan in (scans[w] for w in chosen if w != v):
            distance, index = scan.tree.query(points)
            across = np.abs(np.einsum("ij,ij->i", points - scan.points[index], scan.normals[index]))
            hits.append((distance < _BESIDE * scan.spacing) & (across < _ACROSS * scan.noise))
        shares.append(np.mean(hits, axis=0))
    share = np.concatenate(shares)
    every = np.concatenate(probes)
    still, moving = every[share >= _STANDS], every[share < _MOVES]
    if len(still) < _MOSTLY * len(every) or len(moving) < _SEEN_TO_MOVE:
        return None
    # Some of what stands still is seen seldom, at the rim and in the shadow of the part, and would count as moving:
    # quantiles leave it out.
    part = np.clip(moving, *np.quantile(moving, (_SELDOM, 1 - _SELDOM), axis=0))
    other = np.clip(still, *np.quantile(still, (_SELDOM / 10, 1 - _SELDOM / 10), axis=0))
    size = float(np.linalg.norm(np.ptp(part, axis=0)))
    box = _box_beyond_part(part, other, _bounding_box(every), size)
    return None if box is None else (len(other) / len(every), box)


def _bounding_box(points: Array) -> Array:
    return np.array([points.min(axis=0), points.max(axis=0)])


def _box_beyond_part(part: Array, other: Array, every: Array, size: float) -> Array | None:
    """Return a box (2, 3) of all points, cut by an axis-parallel plane between part and others; None if none fits.

    The box is wider than all points by the size of the part, but for the side that is cut.

    Args:
        part, other: (n, 3) points of the part, and of what else there is.
        every: (2, 3) box of all points.
        size: of the part, length_unit.
    """
    if not len(part):
        return None
    box = every + size * np.array([[-1.0], [1.0]])
    low, high = _bounding_box(part)
    other_low, other_high = _bounding_box(other)
    gaps = np.array([low - other_high, other_low - high])
    side, axis = np.unravel_index(gaps.argmax(), gaps.shape)
    if gaps[side, axis] < _GAP * size:
        return None
    # Four fifths of the way to what stands still: between the probes the part may reach farther.
    near, far = (low[axis], other_high[axis]) if side == 0 else (high[axis], other_low[axis])
    box[side, axis] = 0.2 * near + 0.8 * far
    return box
