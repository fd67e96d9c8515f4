"""Labelled points that contradict the poses: which convention makes every target one point.

Under each hypothesis about the poses the hand-eye follows in closed form, and the targets' scatter about their middle
judges it: millimetres and less where the convention is right, decimetres where it is wrong.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import MAD_TO_SIGMA, nan_median
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array, Indices
from stitch.numerics.units import METRES, length_text
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.observations.targets.outliers import LIMIT_TARGET, drop_mislabelled, find_mislabelled
from stitch.observations.targets.rows import (
    COMPARED_TARGETS,
    distance_sigma,
    target_distances,
    target_positions,
)
from stitch.screening.conventions import RelativeScans, rank_hypotheses
from stitch.screening.hypotheses import UNITS, Hypothesis, distinct, hypotheses, stated_hypothesis
from stitch.screening.problems import SessionProblem, likeliest_text, names_of_views
from stitch.session.capture import Capture, Sightings, build_capture, sightings_of
from stitch.session.session import SessionData

# Labelled points that sit elsewhere among the others from some view on: a ball that was bumped, a nest put back wrong.
#
# Distances between the targets of one view are the same whatever the arm and the hand-eye are. Where those from one
# target to the others step between two views, or change little by little, and those of the others among themselves do
# not, that one has moved; the fit would put it half way, and call the misfit of its views errors of the arm.

# Views on each side of a step: fewer are outliers of their own. Targets, so that one of them can be told.
_SIDE, _TARGETS = 2, 3
# Standard error of a median over that of a mean.
_MEDIAN = 1.25
# Targets that are looked at closely, and how far a single distance pulls where all are looked at, in sigmas.
_LIKELIEST, _CLIPPED = 8, 10.0
# What creeps leaves so much less about a straight line than about a step.
_DRIFT_SHARE = 0.7


@dataclass(frozen=True)
class MovedTarget:
    """From view `start` on a target sits elsewhere among the others, or wanders off over the whole session."""

    target: str
    start: int
    distance: float  # length_unit: by which its distances to the others change at the most
    drifts: bool = False

    def describe(self, view: str, length: str) -> str:
        """Return a warning with what to do; with the name of the view and that distance in words."""
        if self.drifts:
            return (
                f"{self.target} creeps among the targets over the session: its distances to the others change by up to "
                f"{length}; to fix: leave it out of points.csv, and fasten it before you measure again."
            )
        return (
            f"{self.target} sits elsewhere among the targets from view {view} on: its distances to the others change "
            f"by up to {length}; to fix: give it another name from there on in points.csv, or leave it out."
        )


def find_moved_targets(sightings: Sightings) -> tuple[MovedTarget, ...]:
    """Targets that moved once, the clearest first; each is asked without those before it."""
    places, sigma = target_positions(sightings), distance_sigma(sightings)
    left, found = list(range(len(sightings.targets))), list[MovedTarget]()
    while len(left) >= _TARGETS:
        steps = {
            k: _target_step(places[:, left], k, start, sigma)
            for k, start in _most_stepped_targets(places[:, left], sigma)
        }
        k = max(steps, key=lambda k: steps[k][0], default=-1)
        if k < 0 or steps[k][0] < LIMIT_TARGET:
            break
        found.append(replace(steps[k][1], target=sightings.targets[left.pop(k)]))
    return tuple(found)


def _most_stepped_targets(places: Array, sigma: float) -> list[tuple[int, int]]:
    """The targets (V, K, 3) of which means before and after some view differ most, and that view."""
    some = np.linspace(0, places.shape[1] - 1, min(places.shape[1], COMPARED_TARGETS)).astype(int)
    scatter = max(
        sigma, MAD_TO_SIGMA * float(np.median([_typical_distance(_distances_from_median(places, k)) for k in some]))
    )
    found = []
    for k in range(places.shape[1]):
        times = _steps_of_means(_distances_from_median(places, k) / scatter)
        if times.max(initial=0.0) > 0:
            found.append((float(times.max()), k, int(np.argmax(times))))
    return [(k, start) for _, k, start in sorted(found, reverse=True)[:_LIKELIEST]]


def _distances_from_median(places: Array, k: int) -> Array:
    """(V, P) distances from target k to its partners, less the median of each."""
    own = np.linalg.norm(places[:, _partners(places, k)] - places[:, k : k + 1], axis=2)
    return np.asarray(own - nan_median(own))


def _typical_distance(off: Array) -> float:
    seen = np.isfinite(off)
    return float(np.median(np.abs(off[seen]))) if seen.any() else 0.0


def _partners(places: Array, k: int) -> Indices:
    """Other targets that hold one (V, K, 3): of those often seen with it some, all over the list."""
    seen = np.isfinite(places[:, :, 0])
    together = seen[:, k].astype(float) @ seen
    together[k] = 0
    others = np.flatnonzero(together > together.max() / 2)
    return np.asarray(others[np.linspace(0, len(others) - 1, min(len(others), COMPARED_TARGETS - 1)).astype(int)])


def _steps_of_means(off: Array) -> Array:
    """(V,) standard errors by which distances (V, P), in sigmas, step before each view, rms; 0 where few are seen."""
    seen = np.isfinite(off)
    clipped = np.where(seen, np.clip(off, -_CLIPPED, _CLIPPED), 0.0)
    before, sums = (np.cumsum(x, axis=0) - x for x in (seen.astype(float), clipped))
    after = seen.sum(axis=0) - before
    known = (before >= _SIDE) & (after >= _SIDE)
    n, m = np.where(known, before, 1.0), np.where(known, after, 1.0)
    squares = known * (sums / n - (clipped.sum(axis=0) - sums) / m) ** 2 / (1 / n + 1 / m)
    few = known.sum(axis=1) < _TARGETS - 1
    return np.where(few, 0.0, np.sqrt(squares.sum(axis=1) / max(off.shape[1], 1)))


def _target_step(places: Array, k: int, start: int, sigma: float) -> tuple[float, MovedTarget]:
    """Return by how many times the usual step the distances from target k change before a view, and that move."""
    held = _partners(places, k)
    among = target_distances(places[:, held])[:, *np.triu_indices(len(held), 1)]
    mine, rest = (
        _seen_on_both_sides(np.linalg.norm(places[:, held] - places[:, k : k + 1], axis=2), start),
        _seen_on_both_sides(among, start),
    )
    if not rest.shape[1]:
        return 0.0, MovedTarget("", start, 0.0)
    # By the sensor's sigma, or by what is left on both sides: a lens changes distances too, but with every view.
    left = [d - _levels(d, start) for d in (mine, rest)]
    scatter = max(sigma, MAD_TO_SIGMA * float(np.nanmedian(np.abs(np.concatenate(left, axis=1)))))
    (steps, times), (_, usual) = (_median_steps(d, start, scatter) for d in (mine, rest))
    line = mine - _fitted_lines(mine)
    creeps = bool(np.nansum(np.abs(line)) < _DRIFT_SHARE * np.nansum(np.abs(left[0])))
    distance = float(
        np.max(np.nanmax(_fitted_lines(mine), axis=0) - np.nanmin(_fitted_lines(mine), axis=0))
        if creeps
        else steps.max()
    )
    return float(np.median(times) / max(np.median(usual), 1.0)), MovedTarget("", start, distance, creeps)


def _seen_on_both_sides(distances: Array, start: int) -> Array:
    """(V, p) those of the distances that are seen on both sides."""
    seen = np.isfinite(distances)
    return distances[:, (seen[:start].sum(axis=0) >= _SIDE) & (seen[start:].sum(axis=0) >= _SIDE)]


def _levels(distances: Array, start: int) -> Array:
    """(V, p) medians before and from a view on."""
    sides = np.arange(len(distances))[:, None] < start
    return np.where(sides, *(nan_median(half) for half in (distances[:start], distances[start:])))


def _fitted_lines(distances: Array) -> Array:
    """(V, p) straight lines through distances over the session, by least squares."""
    seen = np.isfinite(distances)
    order = np.where(seen, np.arange(len(distances))[:, None], np.nan)
    at = np.where(seen, order - np.nanmean(order, axis=0), 0.0)
    middle = np.nanmean(distances, axis=0)
    slope = np.sum(at * np.where(seen, distances - middle, 0.0), axis=0) / np.maximum(np.sum(at**2, axis=0), 1e-300)
    return np.asarray(np.where(seen, middle + slope * at, np.nan))


def _median_steps(distances: Array, start: int, scatter: float) -> tuple[Array, Array]:
    """(p,) steps of the medians, in length_unit and in standard errors."""
    levels = _levels(distances, start)
    before, after = (np.isfinite(half).sum(axis=0) for half in (distances[:start], distances[start:]))
    steps = np.abs(levels[-1] - levels[0])
    return steps, steps / (_MEDIAN * scatter * np.sqrt(1 / before + 1 / after))


def target_problems(session: SessionData, sightings: Sightings | None) -> list[SessionProblem]:
    """Return views with names mixed up, then targets that moved, with the views from there on."""
    if sightings is None:
        return []
    names, every = session.names, sightings.with_outliers
    mixed_up = find_mislabelled(every)
    out = [SessionProblem("exchanged", (names[m.view],), m.message(names[m.view])) for m in mixed_up]
    for moved in find_moved_targets(drop_mislabelled(every) or every):
        views = () if moved.drifts else names_of_views(range(moved.start, len(names)), names)
        length = length_text(moved.distance, session.length_unit)
        out.append(SessionProblem("displaced", views, moved.describe(names[moved.start], length)))
    return out


def target_warnings(session: SessionData, sightings: Sightings | None) -> tuple[str, ...]:
    """Return the same problems as sentences."""
    return tuple(problem.fix for problem in target_problems(session, sightings))


# No arm is off by more; a better hypothesis must leave a fifth of what the stated one leaves.
_LIMIT_M, _CLEARER = 0.005, 0.2
# Hypotheses that are fitted in full, and targets in one line.
_MAX_HYPOTHESES, _LINE = 12, 0.02
# Views that are tried, of more of them so many in a row all over the session: what is wrong with all shows in these.
_TRIED, _IN_A_ROW = 60, 6
# Views that a side of a common displacement has at least, and the share of views that must be on their side of it.
_SIDE_VIEWS, _ON_ITS_SIDE = 5, 0.9


@dataclass(frozen=True)
class ConventionFit:
    """One hypothesis, with how far apart it leaves the sightings of one target."""

    hypothesis: Hypothesis
    spread: float  # median distance from the target's middle, length_unit
    T_mount: Array  # (4, 4)
    middles: Array  # (K, 3) of the targets, reference frame; NaN where fewer than two views show one


def check_targets(session: SessionData) -> list[SessionProblem]:
    """Return what is wrong with the poses of a session of labelled points; empty if nothing is found."""
    rows, names = _tried_rows(len(session.views)), session.names
    stated = stated_hypothesis(session, rows)
    capture = _capture_of(session, rows)
    limit = _LIMIT_M / METRES[session.length_unit]
    own = _fit_hypothesis(capture, stated)
    most = own is not None and own.spread < limit
    if own is not None and most and np.mean(_distances_from_middles(capture, own) > limit) < 1 - _ON_ITS_SIDE:
        return []
    moved = _find_common_move(session, rows, limit)
    if moved is not None or most:
        return [moved] if moved is not None else []
    tried = _hypotheses_to_try(session, rows, capture, limit)
    fits = [fit for h in tried if (fit := _fit_hypothesis(capture, h)) is not None]
    best = min(fits, key=lambda fit: fit.spread, default=None)
    before = np.inf if own is None else own.spread
    if best is None or best.spread > max(_CLEARER * before, 0.0) or best.spread > limit:
        if own is None:
            return []
        fix = (
            f"the targets scatter by {own.spread:.3g} {session.length_unit} under the best hand-eye, and no usual "
            "mistake explains it; to fix: check names of targets, rows and how the poses were converted"
        )
        return [SessionProblem("displaced", tuple(names), fix)]
    h = best.hypothesis
    others = [f.hypothesis.fix for f in fits if f.spread < 2 * best.spread and f.hypothesis.fix != h.fix]
    views = names_of_views(rows[list(h.rows)], names)
    return [SessionProblem(h.kind, views, likeliest_text([h.fix, *others[:2]]))]


def _tried_rows(views: int) -> Indices:
    """Return the rows that are tried: all of few views."""
    if views <= _TRIED:
        return np.arange(views)
    starts = np.linspace(0, views - _IN_A_ROW, _TRIED // _IN_A_ROW).astype(int)
    return np.asarray(np.unique(starts[:, None] + np.arange(_IN_A_ROW)), np.int64)


def _capture_of(session: SessionData, rows: Indices) -> Capture:
    """Return the labelled points of some rows under the poses as stated."""
    some = replace(session, views=tuple(session.views[v] for v in rows))
    T = stated_hypothesis(some).T_base_flange
    return build_capture(session.name, (), T, session.mount, sightings_of(some))


def _find_common_move(session: SessionData, rows: Indices, limit: float) -> SessionProblem | None:
    """Find the row from which on everything that the sensor shows stands elsewhere; None if there is none.

    A tracker that was knocked over, or a table that was moved: each side of it fits by itself. One side is fitted to a
    third of the views, and the others are held against it.

    Args:
        limit: distance from a target's middle that no arm makes, length_unit.
    """
    capture, count = _capture_of(session, rows), len(rows)
    third = max(count // 3, _SIDE_VIEWS)
    for at_end in (False, True):
        order = np.arange(count)[::-1] if at_end else np.arange(count)
        own = _fit_some(session, rows[np.sort(order[:third])], limit)
        if own is None:
            continue
        off = (_distances_from_middles(capture, own) > limit)[order]
        right = np.array([np.mean(np.append(~off[:k], off[k:])) for k in range(count)])
        k = int(np.argmax(right))
        if right[k] < _ON_ITS_SIDE or not _SIDE_VIEWS <= k <= count - _SIDE_VIEWS:
            continue
        if _fit_some(session, rows[np.sort(order[k:])], limit) is None:
            continue
        # Between the last row on the side that was fitted and the first one on the other.
        near, far = sorted((int(rows[order[k - 1]]), int(rows[order[k]])))
        between = np.arange(near, far + 1)
        beyond = _distances_from_middles(_capture_of(session, between), own) > limit
        start = near + int(np.sum(beyond) if at_end else np.sum(~beyond))
        what = "the tracker" if session.mount == "eye_to_hand" else "all targets together"
        names = session.names
        fix = (
            f"{what}, or the robot's base, moved between {names[start - 1]} and {names[start]}; to fix: make two "
            "sessions of it"
        )
        return SessionProblem("reclamped", tuple(names[start:]), fix)
    return None


def _fit_some(session: SessionData, rows: Indices, limit: float) -> ConventionFit | None:
    """Return the fit to some rows; None where they do not hold together."""
    fit = _fit_hypothesis(_capture_of(session, rows), stated_hypothesis(session, rows))
    return None if fit is None or fit.spread > limit else fit


def _distances_from_middles(capture: Capture, fit: ConventionFit) -> Array:
    """(V,) median distance of what a view shows from where a fit of other views has it; 0 where that has nothing."""
    s = capture.sightings
    assert s is not None
    apart = np.linalg.norm(frames.transform(capture.poses(fit.T_mount), s.points) - fit.middles[s.target], axis=2)
    return np.nan_to_num(nan_median(np.where(s.used, apart, np.nan).T))


def _hypotheses_to_try(session: SessionData, rows: Indices, capture: Capture, length: float) -> Iterator[Hypothesis]:
    """Yield hypotheses to try: where targets show how the sensor moved, those that explain its motions best."""
    ranked, stated = rank_hypotheses(session, _sensor_motions(capture), rows), stated_hypothesis(session, rows)
    if ranked:
        yield from (e.hypothesis for e in ranked[:_MAX_HYPOTHESES] if e.scale == 1.0)
    else:
        yield from distinct(hypotheses(session, rows), 1e-3, 0.1 * length)[1:]
    for factor, words in UNITS.items():
        T = np.array(stated.T_base_flange)
        T[:, :3, 3] *= factor
        fix = f"the sightings are {factor:.6g} times as large as the poses say ({words}); to fix: correct length_unit"
        yield replace(stated, kind="unit", T_base_flange=T, fix=fix)


def _sensor_motions(capture: Capture) -> RelativeScans:
    """Motions of the sensor between views that share three targets or more, by least squares."""
    s = capture.sightings
    assert s is not None
    views, pairs, T = len(s.points), [], []
    for v, w in ((v, v + step) for step in (1, 2) for v in range(views - step)):
        common = np.intersect1d(s.target[v][s.used[v]], s.target[w][s.used[w]])
        if len(common) < 3:
            continue
        a, b = (np.array([s.points[i][s.used[i] & (s.target[i] == k)][0] for k in common]) for i in (v, w))
        spread = np.linalg.svd(a - a.mean(axis=0), compute_uv=False)
        if spread[1] > _LINE * spread[0]:
            pairs.append((v, w))
            T.append(align_points(b, a))
    return RelativeScans(tuple(pairs), np.array(T).reshape(-1, 4, 4))


def _fit_hypothesis(capture: Capture, hypothesis: Hypothesis) -> ConventionFit | None:
    """The closed form under a hypothesis; None where it has none."""
    s = capture.sightings
    assert s is not None
    if hypothesis.used is not None:
        out = np.setdiff1d(np.arange(len(s.points)), hypothesis.used)
        s = replace(s, used=s.used & ~np.isin(np.arange(len(s.points)), out)[:, None])
    own = replace(capture, T_reference_mount=hypothesis.T_reference_mount, sightings=s)
    try:
        T_mount = closed_form_hand_eye(own)
    except (NoResultError, np.linalg.LinAlgError):
        return None
    placed = frames.transform(own.poses(T_mount), s.points)
    apart, middles = [], np.full((len(s.targets), 3), np.nan)
    for k in range(len(s.targets)):
        here = placed[s.used & (s.target == k)]
        if len(here) > 1:
            middles[k] = np.median(here, axis=0)
            apart.append(np.linalg.norm(here - middles[k], axis=1))
    return ConventionFit(hypothesis, float(np.median(np.concatenate(apart))), T_mount, middles) if apart else None
