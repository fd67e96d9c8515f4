"""Balls in a scan, without a guess: pairs of points with their normals vote for centres, robust fits decide.

Two points of a sphere with their normals give its centre and radius; pairs of one sphere agree, pairs of anything else
do not (Schnabel, Wahl & Klein 2007 draw them at random; here all neighbourhoods vote). The scan is thinned again and
again by a factor of two, so that balls of every size are seen with as many points. What is fitted counts as a ball if
it covers a cap in all directions and everything in that cap lies on it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from stitch.detection.ball import Ball, refine_ball
from stitch.frames import Array, Mask
from stitch.measurement.scan import prepare_scan

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


@dataclass(frozen=True)
class _ThinningLevel:
    points: Array  # (N, 3)
    normals: Array  # (N, 3) towards the scanner
    spacing: float


def find_balls(points: Array, limits: tuple[float, float] = (0.0, np.inf)) -> list[Ball]:
    """Convex balls in a scan (N, 3) seen from the origin, the one with most points first; radii free.

    Args:
        limits: of the radius.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < _MIN_BALL_POINTS:
        return []
    noise = prepare_scan("", points, np.arange(0, len(points), max(1, len(points) // 2000))).noise
    found: list[Ball] = []
    for level in _thinning_levels(points, *limits):
        for centre, radius in _candidates(level):
            if any(np.linalg.norm(centre - ball.centre) < 0.5 * ball.radius for ball in found):
                continue
            ball = _confirmed_ball(points, centre, radius, noise)
            if ball is not None and limits[0] <= ball.radius <= limits[1]:
                found.append(ball)
    return _without_overlaps(found)


def _thinning_levels(points: Array, min_radius: float, max_radius: float) -> list[_ThinningLevel]:
    """Ever thinner scans, from the scan's own spacing on; those that show balls of the radii looked for."""
    out: list[_ThinningLevel] = []
    spacing = float(np.median(cKDTree(points).query(points[:: max(1, len(points) // 500)], k=2)[0][:, 1]))
    size = 1.5 * max(spacing, 1e-9 * float(np.ptp(points)))
    while True:
        thin = _thinned(points, size)
        if len(thin) < _THINNEST:
            return out
        if len(thin) <= _THICKEST and size * _RADII[1] > min_radius:
            scan = prepare_scan("", thin)
            out.append(_ThinningLevel(scan.points, scan.normals, size))
        size *= 2.0
        if size * _RADII[0] > max_radius:
            return out


def _thinned(points: Array, size: float) -> Array:
    """Mean of the points of every voxel of edge `size`."""
    keys = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    _, voxel = np.unique(keys @ np.array([1, 1 << 21, 1 << 42]), return_inverse=True)
    count = np.bincount(voxel)
    return np.stack([np.bincount(voxel, column) / count for column in points.T], axis=1)


def _candidates(level: _ThinningLevel) -> list[tuple[Array, float]]:
    """Centres and radii that many pairs agree on, the best first."""
    rng = np.random.default_rng(0)
    N, count = len(level.points), min(_NEIGHBOURS, len(level.points) - 1)
    _, near = cKDTree(level.points).query(level.points, k=count + 1)
    first = np.repeat(np.arange(N), _PAIRS)
    second = near[first, rng.integers(1, count + 1, len(first))]
    apart, turn = level.points[first] - level.points[second], level.normals[first] - level.normals[second]
    square = np.einsum("ij,ij->i", turn, turn)
    radius = np.einsum("ij,ij->i", apart, turn) / np.maximum(square, 1e-12)
    ends = [level.points[i] - radius[:, None] * level.normals[i] for i in (first, second)]
    good = (square > _MIN_NORMAL_ANGLE**2) & (radius > _RADII[0] * level.spacing) & (radius < _RADII[1] * level.spacing)
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


def _without_overlaps(balls: list[Ball]) -> list[Ball]:
    """Balls that do not overlap; of two that do, the one with more points."""
    out: list[Ball] = []
    for ball in sorted(balls, key=lambda ball: -int(ball.keep.sum())):
        if all(np.linalg.norm(ball.centre - b.centre) > 0.7 * max(ball.radius, b.radius) for b in out):
            out.append(ball)
    return out
