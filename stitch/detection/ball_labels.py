"""Which ball is which, over all views: by radius, and by the distances to the others.

Balls of one radius are told apart by the distances between their centres, which no pose changes: the views grow one
arrangement, largest first, and each is laid on it in the way in which most distances agree. Where two ways do as well
as each other, as in an arrangement with symmetry, the angle decides by which the arm has turned between views: a rigid
motion turns scanner and flange by the same angle (Shiu & Ahmad 1989). Where that does not decide either, the
view's balls stay without names.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices

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
    """Per view the number of each of its balls, from 0; None for balls that cannot be told.

    Numbers run by radius, then as they were found.
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
    return _by_radius(names, known)


def _by_radius(names: list[list[int | None]], kinds: Indices) -> list[list[int | None]]:
    rank = {int(old): new for new, old in enumerate(np.argsort(kinds, kind="stable"))}
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
    """Pairs (ball of the view, name) of the one way in which most balls fit; None where there is none or several."""
    view = views[v]
    ways = _largest_matchings(arrangement, view, kinds)
    if not ways:
        return None
    rated = sorted(((_matching_motion(arrangement, view, way), way) for way in ways), key=lambda pair: pair[0][1])
    floor = float(view.sigma.mean()) + 1e-12
    close = [(T, way) for (T, rms), way in rated if rms <= _CLEARLY * max(rated[0][0][1], floor)]
    if len(close) > 1:
        close = [(T, way) for T, way in close if _rotation_agrees(arrangement, views, v, T)]
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
    """T_arrangement_scanner (4, 4) of a way and the rms distance that it leaves (Arun, Huang & Blostein 1987)."""
    own, other = view.centres[[b for b, _ in matching]], arrangement.places[[k for _, k in matching]]
    a, b = own - own.mean(axis=0), other - other.mean(axis=0)
    R = frames.nearest_rotation(b.T @ a)
    left = float(np.sqrt(np.mean(np.sum((b - a @ R.T) ** 2, axis=1))))
    return frames.make(R, other.mean(axis=0) - R @ own.mean(axis=0)), left


def _rotation_agrees(arrangement: _Arrangement, views: Sequence[ViewBalls], v: int, T: Array) -> bool:
    """Whether the scanner has turned by the flange's angle since each view that is placed."""
    own = views[v].R_flange
    for w, R in arrangement.views:
        other = views[w].R_flange
        if own is not None and other is not None and abs(_angle(R.T @ T[:3, :3]) - _angle(other.T @ own)) > _ANGLE:
            return False
    return True


def _angle(R: Array) -> float:
    return float(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))


def _extend_arrangement(
    arrangement: _Arrangement, view: ViewBalls, kinds: Indices, matching: Sequence[tuple[int, int]], v: int
) -> tuple[list[int | None], _Arrangement]:
    """Names of the view's balls; those that are new join the arrangement."""
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
