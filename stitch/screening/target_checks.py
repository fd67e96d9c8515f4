"""Labelled points that contradict the poses: which convention makes every target one point, and which target moved.

Under each hypothesis about the poses the hand-eye follows in closed form, and the targets' scatter about their middle
judges it: millimetres and less where the convention is right, decimetres where it is wrong.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import nan_median
from stitch.numerics.frames import Array, Indices
from stitch.numerics.units import METRES, length_text
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye, sensor_motions
from stitch.observations.targets.outliers import drop_mislabelled, find_mislabelled
from stitch.screening.conventions import rank_hypotheses
from stitch.screening.hypotheses import UNITS, Hypothesis, distinct, hypotheses, problem, stated_hypothesis
from stitch.screening.motions import RelativeScans
from stitch.screening.moved_targets import find_moved_targets
from stitch.screening.problems import SessionProblem, likeliest_text
from stitch.session.capture import Capture, Sightings, build_capture, sightings_of
from stitch.session.session import SessionData

# No arm is off by more; a better hypothesis must leave a fifth of what the stated one leaves.
_LIMIT_M, _CLEARER = 0.005, 0.2
# Hypotheses that are fitted in full.
_MAX_HYPOTHESES = 12
# Views that are tried, of more of them so many in a row all over the session: what is wrong with all shows in these.
_TRIED, _IN_A_ROW = 60, 6
# Views that a side of a common displacement has at least, and the share of views that must be on their side of it.
_SIDE_VIEWS, _ON_ITS_SIDE = 5, 0.9

# How far poses leave the sightings of one target apart: median distance from its middle (length_unit); the hand-eye
# (4, 4); and the middles (K, 3) in the reference frame, NaN where fewer than two views show one.
TargetSpread = tuple[float, Array, Array]


def target_problems(session: SessionData, sightings: Sightings | None) -> list[SessionProblem]:
    """Return views with names mixed up, then targets that moved, with the views from there on."""
    if sightings is None:
        return []
    names = session.names
    every = sightings.with_outliers
    mixed_up = find_mislabelled(every)
    out = [problem("names of targets", [names[m.view]], message=m.message(names[m.view])) for m in mixed_up]
    for moved in find_moved_targets(drop_mislabelled(every) or every):
        views = () if moved.drifts else tuple(names[moved.start :])
        length = length_text(moved.distance, session.length_unit)
        out.append(SessionProblem("displaced", views, moved.describe(names[moved.start], length)))
    return out


def target_warnings(session: SessionData, sightings: Sightings | None) -> tuple[str, ...]:
    """Return the same problems as sentences."""
    return tuple(found.fix for found in target_problems(session, sightings))


def check_targets(session: SessionData) -> list[SessionProblem]:
    """Return what is wrong with the poses of a session of labelled points; empty if nothing is found."""
    rows = _tried_rows(len(session.views))
    stated = stated_hypothesis(session, rows)
    capture = _capture_of(session, rows)
    limit = _LIMIT_M / METRES[session.length_unit]
    as_stated = _fit_hypothesis(capture, stated)
    most_agree = as_stated is not None and as_stated[0] < limit
    if as_stated is not None and most_agree:
        off = _distances_from_middles(capture, as_stated) > limit
        if np.mean(off) < 1 - _ON_ITS_SIDE:
            return []
    moved = _find_common_move(session, rows, limit)
    if moved is not None or most_agree:
        return [moved] if moved is not None else []
    tried = _hypotheses_to_try(session, rows, capture, limit)
    spreads = [(h, fit[0]) for h in tried if (fit := _fit_hypothesis(capture, h)) is not None]
    best, spread = min(spreads, key=lambda pair: pair[1], default=(stated, np.inf))
    before = np.inf if as_stated is None else as_stated[0]
    if not spreads or spread > _CLEARER * before or spread > limit:
        if as_stated is None:
            return []
        return [problem("unexplained targets", session.names, by=f"{as_stated[0]:.3g} {session.length_unit}")]
    others = [h.fix for h, other in spreads if other < 2 * spread and h.fix != best.fix]
    views = tuple(session.names[v] for v in rows[list(best.rows)])
    return [SessionProblem(best.kind, views, likeliest_text([best.fix, *others[:2]]))]


def _tried_rows(views: int) -> Indices:
    """Return the rows that are tried: all of few views."""
    if views <= _TRIED:
        return np.arange(views)
    starts = np.linspace(0, views - _IN_A_ROW, _TRIED // _IN_A_ROW).astype(int)
    return np.unique(starts[:, None] + np.arange(_IN_A_ROW))


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
    capture = _capture_of(session, rows)
    count = len(rows)
    third = max(count // 3, _SIDE_VIEWS)
    for at_end in (False, True):
        order = np.arange(count)[::-1] if at_end else np.arange(count)
        fit = _fit_some(session, rows[np.sort(order[:third])], limit)
        if fit is None:
            continue
        beyond = (_distances_from_middles(capture, fit) > limit)[order]
        right = np.array([np.mean(np.append(~beyond[:k], beyond[k:])) for k in range(count)])
        k = int(np.argmax(right))
        if right[k] < _ON_ITS_SIDE or not _SIDE_VIEWS <= k <= count - _SIDE_VIEWS:
            continue
        if _fit_some(session, rows[np.sort(order[k:])], limit) is None:
            continue
        # Between the last row on the side that was fitted and the first one on the other.
        near, far = sorted((int(rows[order[k - 1]]), int(rows[order[k]])))
        between = np.arange(near, far + 1)
        beyond = _distances_from_middles(_capture_of(session, between), fit) > limit
        start = near + int(np.sum(beyond) if at_end else np.sum(~beyond))
        sensor_or_targets = "the tracker" if session.mount == "eye_to_hand" else "all targets together"
        what = f"{sensor_or_targets}, or the robot's base, moved"
        names = session.names
        return problem("moved", names[start:], what=what, before=names[start - 1], after=names[start])
    return None


def _fit_some(session: SessionData, rows: Indices, limit: float) -> TargetSpread | None:
    """Return the fit to some rows; None where they do not hold together."""
    fit = _fit_hypothesis(_capture_of(session, rows), stated_hypothesis(session, rows))
    return None if fit is None or fit[0] > limit else fit


def _distances_from_middles(capture: Capture, fit: TargetSpread) -> Array:
    """(V,) median distance of what a view shows from where a fit of other views has it; 0 where that has nothing."""
    s = capture.sightings
    assert s is not None
    _, T_mount, middles = fit
    apart = np.linalg.norm(frames.transform(capture.poses(T_mount), s.points) - middles[s.target], axis=2)
    return np.nan_to_num(nan_median(np.where(s.used, apart, np.nan).T))


def _hypotheses_to_try(session: SessionData, rows: Indices, capture: Capture, length: float) -> Iterator[Hypothesis]:
    """Yield hypotheses to try: where targets show how the sensor moved, those that explain its motions best."""
    assert capture.sightings is not None
    pairs, T_first_second = sensor_motions(capture.sightings)
    motions = RelativeScans(tuple((int(v), int(w)) for v, w in pairs), T_first_second)
    ranked = rank_hypotheses(session, motions, rows)
    if ranked:
        yield from (fit.hypothesis for fit in ranked[:_MAX_HYPOTHESES] if fit.scale == 1.0)
    else:
        yield from distinct(hypotheses(session, rows), 1e-3, 0.1 * length)[1:]
    stated = stated_hypothesis(session, rows)
    for factor, units in UNITS.items():
        T = np.array(stated.T_base_flange)
        T[:, :3, 3] *= factor
        yield stated.undone("sightings", T, factor=factor, units=units)


def _fit_hypothesis(capture: Capture, hypothesis: Hypothesis) -> TargetSpread | None:
    """Return the closed form under a hypothesis; None where it has none."""
    s = capture.sightings
    assert s is not None
    if hypothesis.used is not None:
        used = np.isin(np.arange(len(s.points)), hypothesis.used)
        s = replace(s, used=s.used & used[:, None])
    posed = replace(capture, T_reference_mount=hypothesis.T_reference_mount, sightings=s)
    try:
        T_mount = closed_form_hand_eye(posed)
    except (NoResultError, np.linalg.LinAlgError):
        return None
    placed = frames.transform(posed.poses(T_mount), s.points)
    middles = np.full((len(s.targets), 3), np.nan)
    apart = []
    for k in range(len(s.targets)):
        places = placed[s.used & (s.target == k)]
        if len(places) > 1:
            middles[k] = np.median(places, axis=0)
            apart.append(np.linalg.norm(places - middles[k], axis=1))
    return (float(np.median(np.concatenate(apart))), T_mount, middles) if apart else None
