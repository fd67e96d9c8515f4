"""Balls in a scan, without a guess: pairs of points with their normals vote for centres, robust fits decide.

Two points of a sphere with their normals give its centre and radius; pairs of one sphere agree, pairs of anything else
do not (Schnabel, Wahl & Klein 2007 draw them at random; here all neighbourhoods vote). The scan is thinned again and
again by a factor of two, so that balls of every size are seen with as many points. What is fitted counts as a ball if
it covers a cap in all directions and everything in that cap lies on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.distributions import MAD_TO_SIGMA
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array, Indices, Mask
from stitch.session.scan import Scan, prepare_scan
from stitch.session.session import Sighting
from stitch.system.threads import parallel

_TRIALS = 200
# Larger circles than this many sizes are of flat things beside the ball.
_LARGEST = 3.0
# Points for the search and the fit of one view; the joint fit sees all of them.
_POINTS = 3000
# Points this many robust sigmas off the fitted circle or sphere are of something else.
_OUTLIER_GATE = 6.0
# Distances agree within this share, and within so many sigmas.
_DISTANCE_SHARE, _DISTANCE_SIGMAS = 0.004, 5.0
# Radii that differ by less belong together.
_RADIUS_SHARE = 0.04
# Another way counts as as good if its rms is at most so many times larger.
_CLEARLY = 3.0
# Angles of scanner and flange agree within (rad): hundredths of a degree of poses, tenths of balls close together.
_ANGLE = np.radians(2.0)
_MIN_COMMON_BALLS = 3
# Steps of the search for one view: a grid of many balls has more, and its ways are alike anyway.
_MOST_STEPS = 100_000
# Radii looked for at one thinning, in its spacing: a cap of 60° then has 30 to 600 points.
_RADII = (3.0, 14.0)
# Neighbours that pairs are drawn from, pairs a point, and pairs in all.
_NEIGHBOURS, _PAIRS, _MOST = 48, 8, 30000
# Sine of the least angle between normals of a pair; how far its two centres may lie apart, of the radius.
_MIN_NORMAL_ANGLE, _MIN_PAIR_DISTANCE = 0.3, 0.15
# Votes lie together within this share of the radius; fewer make no candidate; candidates a thinning.
_VOTE_RADIUS, _VOTES, _CANDIDATES = 0.1, 8, 12
_MIN_BALL_POINTS = 60
# Robust sigma about a ball, of its radius, unless the scan is noisier: then of the noise.
_ROUND, _NOISES = 0.006, 3.0
# The cap that must be covered: its half angle, the number of equal cells on the whole sphere, and the share of it that
# is covered, as well as that of the points in its cone that lie on the ball.
_CAP, _CELLS, _COVERED = np.radians(35.0), 200, 0.75
# The same before a fit: within this share of the radius.
_ROUGHLY, _ROUGHLY_COVERED = 0.06, 0.6
_THINNEST, _THICKEST = 150, 200_000
# A radius belongs to the one stated within this share, and within so many sigmas.
_STATED_RADIUS_SHARE, _STATED_RADIUS_SIGMAS = 0.02, 4.0
# Radii around the stated ones that are looked at first.
_AROUND = 1.5


@dataclass(frozen=True)
class Ball:
    """Circle (k = 2) or sphere (k = 3)."""

    centre: Array  # (k,)
    radius: float
    sigma: float  # robust sigma of the distances, length unit
    keep: Mask  # (N,) the points of the circle or sphere
    covariance: Array  # (k + 1, k + 1) of centre and radius, both free, from the points' sigma


def fit_ball(points: Array, size: float, known: bool = False) -> Ball:
    """Fit a circle (k = 2) or a sphere (k = 3) to points (N, k), robustly.

    Other things may be in the scan: the search draws its points from neighbourhoods of the ball's size and
    counts those within 2 % of it (RANSAC); the fit minimises a soft L1 loss of the distances at the scale that they
    show themselves.

    Args:
        size: about the radius; with `known` exactly, and only the centre is sought.
    """
    centre, found = _ransac(points[:: max(1, len(points) // _POINTS)], size)
    return refine_ball(points, centre, found, size if known else None)


def refine_ball(points: Array, centre: Array, radius: float, known: float | None = None) -> Ball:
    """Robust fit to points (N, k) from a first centre (k,) and radius; others may be among them.

    Args:
        known: the radius, where only the centre is sought.
    """
    thin = points[:: max(1, len(points) // _POINTS)]
    x = centre if known is not None else np.append(centre, radius)
    inside, scale = _distances(np.append(centre, radius), thin, None), 0.02 * (known or radius)
    gate = scale
    for _ in range(4):
        kept = thin[np.abs(inside) < gate]
        if len(kept) <= len(x):
            break
        x = least_squares(_distances, x, args=(kept, known), loss="soft_l1", f_scale=scale, x_scale="jac").x
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(_distances(x, kept, known)))), 1e-9 * scale)
        inside, gate = _distances(x, thin, known), _OUTLIER_GATE * scale
    off = _distances(x, points, known)
    k, keep, sigma = points.shape[1], np.abs(off) < gate, scale
    outward = points[keep] - x[:k]
    rows = np.column_stack([outward / np.linalg.norm(outward, axis=1, keepdims=True), np.ones(len(outward))])
    covariance = sigma**2 * np.linalg.pinv(rows.T @ rows)
    return Ball(x[:k], float(x[k] if known is None else known), sigma, keep, covariance)


def _distances(x: Array, points: Array, radius: float | None) -> Array:
    k = points.shape[1]
    return np.asarray(np.linalg.norm(points - x[:k], axis=1) - (x[k] if radius is None else radius))


def _ransac(points: Array, size: float) -> tuple[Array, float]:
    """Centre and radius with most points within the gate; spheres through k + 1 neighbouring points each."""
    rng = np.random.default_rng(0)
    k, middle = points.shape[1], points.mean(axis=0)
    local = points - middle
    draws = local[_neighbours(local, size, k + 1, rng)]
    # |p|² = 2 c·p + (r² − |c|²) for each of the k + 1 points.
    system = np.concatenate([2 * draws, np.ones((_TRIALS, k + 1, 1))], axis=2)
    good = np.abs(np.linalg.det(system)) > (1e-3 * size) ** k
    whole = np.hstack([2 * local, np.ones((len(local), 1))])
    candidates = [np.linalg.lstsq(whole, (local**2).sum(axis=1), rcond=None)[0]]
    candidates += list(np.linalg.solve(system[good], (draws[good] ** 2).sum(axis=2)[..., None])[..., 0])
    best, most = (local[0], size), -1
    for x in candidates:
        radius = float(np.sqrt(max(x[k] + x[:k] @ x[:k], 0.0)))
        count = int((np.abs(np.linalg.norm(local - x[:k], axis=1) - radius) < 0.02 * size).sum())
        if count > most and radius < _LARGEST * size:
            best, most = (x[:k], radius), count
    return best[0] + middle, best[1]


def _neighbours(points: Array, size: float, count: int, rng: np.random.Generator) -> Indices:
    """Indices (trials, count) of random points no further than `size` from a first one."""
    out = rng.integers(len(points), size=(_TRIALS, count))
    for trial in out:
        near = np.flatnonzero(((points - points[trial[0]]) ** 2).sum(axis=1) < size**2)
        trial[1:] = rng.choice(near, count - 1)
    return out


@dataclass(frozen=True)
class ViewBalls:
    """B balls of one view."""

    centres: Array  # (B, 3) scanner frame
    sigma: Array  # (B,) of a coordinate
    radii: Array  # (B,)
    R_flange: Array | None  # (3, 3) R_base_flange, where it is known


@dataclass(frozen=True)
class _Arrangement:
    """The arrangement so far: a place and a kind for each name, in the frame of the first view."""

    places: Array  # (K, 3)
    kinds: Indices  # (K,)
    views: tuple[tuple[int, Array], ...]  # view and its R_arrangement_scanner


def label_balls(views: Sequence[ViewBalls]) -> list[list[int | None]]:
    """Return per view the number of each of its balls, from 0; None for balls that cannot be told.

    Numbers run by radius, then as they were found. Balls of one radius are told apart by the distances between their
    centres, which no pose changes: the views grow one arrangement, largest first, and each is laid on it in the way in
    which most distances agree. Where two ways do as well as each other, as in an arrangement with symmetry, the angle
    decides by which the arm has turned between views: a rigid motion turns scanner and flange by the same angle (Shiu &
    Ahmad 1989). Where that does not decide either, the view's balls stay without names.
    """
    kinds = _radius_classes(views)
    order = sorted(range(len(views)), key=lambda v: -len(kinds[v]))
    names: list[list[int | None]] = [[None] * len(k) for k in kinds]
    if not order or not len(kinds[order[0]]):
        return names
    single = {kind for kind in np.unique(np.concatenate(kinds)) if all((k == kind).sum() < 2 for k in kinds)}
    first = order[0]
    arrangement = _Arrangement(views[first].centres, kinds[first], ((first, np.eye(3)),))
    if len(kinds[first]) >= _MIN_COMMON_BALLS or all(kind in single for kind in kinds[first]):
        names[first] = list(range(len(kinds[first])))
    # A view that shares too little with the first may share enough with what the others have added.
    waiting = order[1:]
    while waiting:
        grown = []
        for v in waiting:
            way = _best_matching(arrangement, views, v, kinds[v])
            if way is not None:
                names[v], arrangement = _extend_arrangement(arrangement, views[v], kinds[v], way, v)
                grown.append(v)
        waiting = [v for v in waiting if v not in grown]
        if not grown:
            break
    # The only ball of its size needs no others.
    known = np.append(arrangement.kinds, [k for k in single if k not in arrangement.kinds]).astype(int)
    for v, own in enumerate(kinds):
        names[v] = [
            int(np.flatnonzero(known == k)[0]) if k in single else name for k, name in zip(own, names[v], strict=True)
        ]
    rank = {int(old): new for new, old in enumerate(np.argsort(known, kind="stable"))}
    return [[None if name is None else rank[name] for name in own] for own in names]


def _radius_classes(views: Sequence[ViewBalls]) -> list[Indices]:
    """Per view the class of each radius, from the smallest."""
    radii = np.concatenate([view.radii for view in views]) if views else np.zeros(0)
    ordered = np.sort(radii)
    edges = ordered[1:][np.diff(ordered) > _RADIUS_SHARE * ordered[1:]]
    return [np.searchsorted(edges, view.radii, side="right") for view in views]


def _best_matching(
    arrangement: _Arrangement, views: Sequence[ViewBalls], v: int, kinds: Indices
) -> list[tuple[int, int]] | None:
    """Return pairs (ball of the view, name) of the one way in which most balls fit; None for none or several."""
    view = views[v]
    ways = _largest_matchings(arrangement, view, kinds)
    if not ways:
        return None
    rated = sorted(((_matching_motion(arrangement, view, way), way) for way in ways), key=lambda pair: pair[0][1])
    floor = float(view.sigma.mean()) + 1e-12
    close = [(T, way) for (T, rms), way in rated if rms <= _CLEARLY * max(rated[0][0][1], floor)]
    if len(close) > 1:
        # The scanner has turned by the flange's angle since each view that is placed.
        turned = [(R, views[w].R_flange) for w, R in arrangement.views]
        close = [
            (T, way)
            for T, way in close
            if all(
                view.R_flange is None
                or flange is None
                or abs(frames.angle_between(R, T) - frames.angle_between(flange, view.R_flange)) <= _ANGLE
                for R, flange in turned
            )
        ]
    return close[0][1] if len(close) == 1 else None


def _largest_matchings(arrangement: _Arrangement, view: ViewBalls, kinds: Indices) -> list[list[tuple[int, int]]]:
    """Every largest set of pairs whose distances agree: cliques, ball by ball; none where the search is too long."""
    K, B = len(arrangement.places), len(kinds)
    there = np.linalg.norm(arrangement.places[:, None] - arrangement.places[None], axis=2)
    here = np.linalg.norm(view.centres[:, None] - view.centres[None], axis=2)
    room = _DISTANCE_SHARE * here + _DISTANCE_SIGMAS * np.hypot(view.sigma[:, None], view.sigma[None])
    found, steps = [list[tuple[int, int]]()], [0]

    def grow(b: int, way: list[tuple[int, int]]) -> None:
        steps[0] += 1
        most = max(_MIN_COMMON_BALLS, len(found[0]))
        if len(way) + B - b < most or steps[0] > _MOST_STEPS:
            return
        if b == B:
            found[:] = [way] if len(way) > len(found[0]) else [*found, way]
            return
        for k in range(K):
            fits = arrangement.kinds[k] == kinds[b] and all(n != k for _, n in way)
            if fits and all(abs(here[b, a] - there[k, n]) < room[b, a] for a, n in way):
                grow(b + 1, [*way, (b, k)])
        grow(b + 1, way)

    grow(0, [])
    return found if found[0] and steps[0] <= _MOST_STEPS else []


def _matching_motion(
    arrangement: _Arrangement, view: ViewBalls, matching: Sequence[tuple[int, int]]
) -> tuple[Array, float]:
    """Return T_arrangement_scanner (4, 4) of a way and the rms distance that it leaves."""
    own, other = view.centres[[b for b, _ in matching]], arrangement.places[[k for _, k in matching]]
    T = align_points(own, other)
    return T, float(np.sqrt(np.mean(np.sum((other - frames.transform(T, own)) ** 2, axis=1))))


def _extend_arrangement(
    arrangement: _Arrangement, view: ViewBalls, kinds: Indices, matching: Sequence[tuple[int, int]], v: int
) -> tuple[list[int | None], _Arrangement]:
    """Name the view's balls; those that are new join the arrangement."""
    T, _ = _matching_motion(arrangement, view, matching)
    named = dict(matching)
    places, classes, names = list(arrangement.places), list(arrangement.kinds), list[int | None]()
    for b, centre in enumerate(frames.transform(T, view.centres)):
        taken = np.linalg.norm(np.array(places) - centre, axis=1) < view.radii[b]
        if b not in named and not taken.any():
            named[b] = len(places)
            places.append(centre)
            classes.append(kinds[b])
        # One that is there already, at another distance than it should have, stays without a name.
        names.append(named.get(b))
    return names, _Arrangement(np.array(places), np.array(classes), (*arrangement.views, (v, T[:3, :3])))


def find_balls(points: Array, limits: tuple[float, float] = (0.0, np.inf)) -> list[Ball]:
    """Find convex balls in a scan (N, 3) seen from the origin, the one with most points first; radii free.

    Args:
        limits: of the radius.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < _MIN_BALL_POINTS:
        return []
    noise = prepare_scan("", points, np.arange(0, len(points), max(1, len(points) // 2000))).noise
    found: list[Ball] = []
    for scan, spacing in _thinning_levels(points, *limits):
        for centre, radius in _candidates(scan, spacing):
            if any(np.linalg.norm(centre - ball.centre) < 0.5 * ball.radius for ball in found):
                continue
            ball = _confirmed_ball(points, centre, radius, noise)
            if ball is not None and limits[0] <= ball.radius <= limits[1]:
                found.append(ball)
    # Of two that overlap, the one with more points.
    out: list[Ball] = []
    for ball in sorted(found, key=lambda ball: -int(ball.keep.sum())):
        if all(np.linalg.norm(ball.centre - b.centre) > 0.7 * max(ball.radius, b.radius) for b in out):
            out.append(ball)
    return out


def _thinning_levels(points: Array, min_radius: float, max_radius: float) -> list[tuple[Scan, float]]:
    """Ever thinner scans with their spacing, from the scan's own on; those that show balls of the radii looked for."""
    out: list[tuple[Scan, float]] = []
    spacing = float(np.median(cKDTree(points).query(points[:: max(1, len(points) // 500)], k=2)[0][:, 1]))
    size = 1.5 * max(spacing, 1e-9 * float(np.ptp(points)))
    while True:
        thin = _thinned(points, size)
        if len(thin) < _THINNEST:
            return out
        if len(thin) <= _THICKEST and size * _RADII[1] > min_radius:
            out.append((prepare_scan("", thin), size))
        size *= 2.0
        if size * _RADII[0] > max_radius:
            return out


def _thinned(points: Array, size: float) -> Array:
    """Mean of the points of every voxel of edge `size`."""
    keys = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    _, voxel = np.unique(keys @ np.array([1, 1 << 21, 1 << 42]), return_inverse=True)
    count = np.bincount(voxel)
    return np.stack([np.bincount(voxel, column) / count for column in points.T], axis=1)


def _candidates(scan: Scan, spacing: float) -> list[tuple[Array, float]]:
    """Centres and radii that many pairs agree on, the best first."""
    rng = np.random.default_rng(0)
    N, count = len(scan.points), min(_NEIGHBOURS, len(scan.points) - 1)
    _, near = cKDTree(scan.points).query(scan.points, k=count + 1)
    first = np.repeat(np.arange(N), _PAIRS)
    second = near[first, rng.integers(1, count + 1, len(first))]
    apart, turn = scan.points[first] - scan.points[second], scan.normals[first] - scan.normals[second]
    square = np.einsum("ij,ij->i", turn, turn)
    radius = np.einsum("ij,ij->i", apart, turn) / np.maximum(square, 1e-12)
    ends = [scan.points[i] - radius[:, None] * scan.normals[i] for i in (first, second)]
    good = (square > _MIN_NORMAL_ANGLE**2) & (radius > _RADII[0] * spacing) & (radius < _RADII[1] * spacing)
    good &= np.linalg.norm(ends[0] - ends[1], axis=1) < _MIN_PAIR_DISTANCE * radius
    centre, radius = (ends[0] + ends[1])[good] / 2, radius[good]
    if len(centre) > _MOST:
        picked = rng.choice(len(centre), _MOST, replace=False)
        centre, radius = centre[picked], radius[picked]
    if not len(centre):
        return []
    tree = cKDTree(centre)
    votes = tree.query_ball_point(centre, _VOTE_RADIUS * radius, return_length=True)
    out: list[tuple[Array, float]] = []
    free = votes >= _VOTES
    while free.any() and len(out) < _CANDIDATES:
        i = int(np.argmax(np.where(free, votes, 0)))
        around = tree.query_ball_point(centre[i], _VOTE_RADIUS * radius[i])
        out.append((np.median(centre[around], axis=0), float(np.median(radius[around]))))
        free &= np.linalg.norm(centre - out[-1][0], axis=1) > 0.5 * out[-1][1]
        free[i] = False
    return out


def _confirmed_ball(points: Array, centre: Array, radius: float, noise: float) -> Ball | None:
    """The ball there, fitted to all points; None where there is none."""
    local = points[np.linalg.norm(points - centre, axis=1) < 1.3 * radius]
    # Most candidates are none: seen at once, without a fit.
    near = np.abs(np.linalg.norm(local - centre, axis=1) - radius) < _ROUGHLY * radius
    if not _is_cap(local, centre, near, _ROUGHLY_COVERED):
        return None
    for _ in range(2):
        if len(local) < _MIN_BALL_POINTS:
            return None
        ball = refine_ball(local, centre, radius)
        if not 0.6 * radius < ball.radius < 1.6 * radius or ball.keep.sum() < _MIN_BALL_POINTS:
            return None
        centre, radius = ball.centre, ball.radius
        local = points[np.linalg.norm(points - centre, axis=1) < 1.3 * radius]
    ball = refine_ball(local, centre, radius)
    rough = ball.sigma > max(_ROUND * ball.radius, _NOISES * noise)
    return None if rough or not _is_cap(local, ball.centre, ball.keep, _COVERED) else ball


def _is_cap(local: Array, centre: Array, on_ball: Mask, share: float) -> bool:
    """Whether the points on the ball cover a cap of it around the middle of what is seen, and nothing else is there."""
    if on_ball.sum() < _MIN_BALL_POINTS:
        return False
    outward = local - centre
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    middle = outward[on_ball].mean(axis=0)
    middle /= max(float(np.linalg.norm(middle)), 1e-12)
    in_cone = outward @ middle > np.cos(_CAP)
    if not in_cone.any() or (on_ball & in_cone).sum() < share * in_cone.sum():
        return False
    cells = _even_directions()
    wanted = cells @ middle > np.cos(_CAP)
    nearest = cKDTree(cells).query(outward[on_ball])[1]
    return bool(np.isin(np.flatnonzero(wanted), nearest).mean() > share)


def _even_directions() -> Array:
    """(_CELLS, 3) directions spread evenly (Fibonacci lattice, González 2010)."""
    i = np.arange(_CELLS) + 0.5
    z, angle = 1 - 2 * i / _CELLS, np.pi * (1 + np.sqrt(5)) * i
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def ball_sightings(
    clouds: Sequence[Array | None], rotations: Sequence[Array | None], stated: Sequence[float], to_mm: float
) -> tuple[list[Sighting], list[str]]:
    """Find the centres of the balls in every view, checked against the radius and told apart over all views.

    Args:
        clouds: (N, 3) a view, scanner frame; None for a view without a scan.
        rotations: (3, 3) R_base_flange a view, where it is known.
        stated: radii, in the unit of the clouds; none for balls of any radius.
        to_mm: millimetres per unit, for messages.

    Returns:
        A sighting a view, empty where no ball is seen or told apart, and what was left out, in words.

    Raises:
        InputError: balls of another radius than stated; names the one found.
    """
    seen = _find_all_balls(clouds, stated)
    if stated and any(seen):
        kept = [[ball for ball in view if _stated_radius(ball, stated) is not None] for view in seen]
        if not any(kept):
            raise _radius_error(seen, stated, to_mm)
        seen = kept
    agreed = _agree_on_radius(clouds, seen, stated)
    views = [_view_balls(balls, R) for balls, R in zip(agreed, rotations, strict=True)]
    labels = label_balls(views)
    out, nameless = [], [sum(name is None for name in names) for names in labels]
    for view, names in zip(views, labels, strict=True):
        told = np.array([name is not None for name in names], bool)
        words = tuple(f"ball{name + 1}" for name in names if name is not None)
        out.append(Sighting(words, view.centres[told], view.sigma[told]))
    balls, shown = sum(nameless), int(np.count_nonzero(nameless))
    note = (
        f"{balls} ball{'s' * (balls > 1)} in {shown} view{'s' * (shown > 1)} cannot be told from others of the same "
        "size and are left out; three or more a view at distances that all differ, or balls of different sizes, can"
    )
    return out, [note] if any(nameless) else []


def _find_all_balls(clouds: Sequence[Array | None], stated: Sequence[float]) -> list[list[Ball]]:
    """Find balls of every view, near the radii stated; of any radius where there are none."""
    limits = (min(stated) / _AROUND, max(stated) * _AROUND) if stated else (0.0, float("inf"))
    found = list(parallel(lambda cloud: [] if cloud is None else find_balls(cloud, limits), clouds))
    if any(found) or not stated:
        return found
    return list(parallel(lambda cloud: [] if cloud is None else find_balls(cloud), clouds))


def _sigma_of_radius(ball: Ball) -> float:
    return float(np.sqrt(ball.covariance[-1, -1]))


def _sigma_of_centre(ball: Ball) -> float:
    """Of a coordinate, where the radius is known."""
    C = ball.covariance
    known = C[:3, :3] - np.outer(C[:3, 3], C[3, :3]) / C[3, 3]
    return float(np.sqrt(max(np.trace(known) / 3, 0.0)))


def _stated_radius(ball: Ball, stated: Sequence[float]) -> float | None:
    nearest = min(stated, key=lambda radius: abs(radius - ball.radius))
    room = max(_STATED_RADIUS_SHARE * nearest, _STATED_RADIUS_SIGMAS * _sigma_of_radius(ball))
    return nearest if abs(ball.radius - nearest) <= room else None


def _radius_error(balls: Sequence[Sequence[Ball]], stated: Sequence[float], to_mm: float) -> InputError:
    """Return a refusal that names the radius seen most."""
    radii = np.sort([ball.radius for view in balls for ball in view])
    groups = np.split(radii, np.flatnonzero(np.diff(radii) > 2 * _STATED_RADIUS_SHARE * radii[1:]) + 1)
    group = max(groups, key=len)
    found, views = float(np.median(group)) * to_mm, sum(any(b.radius in group for b in view) for view in balls)
    told = ", ".join(f"{radius * to_mm:g}" for radius in stated)
    return InputError(
        f"--ball {told}: no ball of this radius; balls of {found:.2f} mm are seen in {views} view{'s' * (views > 1)}",
        fix_cli=f"state --ball {found:.2f} or --ball any, or correct cloud_unit in session.toml",
        fix_python=f'pass balls=[{found:.2f}] or balls="any", or correct cloud_unit',
    )


def _agree_on_radius(
    clouds: Sequence[Array | None], balls: Sequence[Sequence[Ball]], stated: Sequence[float]
) -> list[list[tuple[Ball, float]]]:
    """Fit the balls anew with one radius for each size: the one stated, or the mean over the views.

    Beside each ball stands the scatter of the radius over the views, beyond what a view's own points explain.
    """
    every = [ball for view in balls for ball in view]
    radii = np.array([ball.radius for ball in every])
    out = []
    for cloud, view in zip(clouds, balls, strict=True):
        own = []
        for ball in view:
            alike = np.abs(radii - ball.radius) <= _STATED_RADIUS_SHARE * ball.radius
            said = _stated_radius(ball, stated) if stated else None
            radius = said if said is not None else float(np.median(radii[alike]))
            noise = float(np.mean([_sigma_of_radius(b) ** 2 for b, same in zip(every, alike, strict=True) if same]))
            spread = float(np.mean((radii[alike] - radius) ** 2))
            assert cloud is not None
            local = cloud[np.linalg.norm(cloud - ball.centre, axis=1) < 1.3 * radius]
            fitted = refine_ball(local, ball.centre, ball.radius, known=radius)
            own.append((fitted, float(np.sqrt(max(spread - noise, 0.0)))))
        out.append(own)
    return out


def _view_balls(balls: Sequence[tuple[Ball, float]], R_flange: Array | None) -> ViewBalls:
    # A radius that differs from view to view is an error of the scanner: the centre has one of that size too.
    sigma = [np.hypot(_sigma_of_centre(ball), scatter) for ball, scatter in balls]
    centres = np.array([ball.centre for ball, _ in balls]).reshape(-1, 3)
    return ViewBalls(centres, np.array(sigma), np.array([ball.radius for ball, _ in balls]), R_flange)
