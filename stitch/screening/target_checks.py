"""Labelled points that contradict the poses: which convention makes every target one point, and which target moved.

Under each hypothesis about the poses the hand-eye follows in closed form, and the targets' scatter about their middle
judges it: millimetres and less where the convention is right, decimetres where it is wrong.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Indices
from stitch.numerics.least_squares import less_group_means
from stitch.numerics.units import METRES, length_text
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye, sensor_motions
from stitch.observations.targets.outliers import drop_mislabelled, find_mislabelled
from stitch.screening.common_move import find_common_move
from stitch.screening.conventions import rank_hypotheses
from stitch.screening.hypotheses import UNITS, Hypothesis, distinct, hypotheses, problem, stated_hypothesis
from stitch.screening.motions import RelativeScans
from stitch.screening.moved_targets import find_moved_targets
from stitch.screening.problems import SessionProblem, likeliest_text
from stitch.session.capture import Capture, Sightings, build_capture, sightings_of
from stitch.session.session import SessionData

# Arms that are off by this much, and by this share of how far the targets move, are bad and may be right; a better
# hypothesis must leave a fifth of what the stated one leaves.
_LIMIT_M, _SHARE_OF_MOTION, _CLEARER = 0.005, 0.1, 0.2
# Hypotheses that are fitted in full.
_MAX_HYPOTHESES = 12
# Views that are tried, of more of them so many in a row all over the session: what is wrong with all shows in these.
_TRIED, _IN_A_ROW = 60, 6


def target_problems(session: SessionData, sightings: Sightings | None) -> list[SessionProblem]:
    """Return the problems of views whose target names are mixed up, then of targets that moved among the others."""
    if sightings is None:
        return []
    names = session.names
    every = sightings.with_outliers
    mixed_up = find_mislabelled(every)
    out = [problem("names of targets", [names[m.view]], message=m.message(names[m.view])) for m in mixed_up]
    for moved in find_moved_targets(drop_mislabelled(every) or every):
        mistake, views = ("target creeps", []) if moved.drifts else ("target moved", names[moved.start :])
        length = length_text(moved.distance, session.length_unit)
        out.append(problem(mistake, views, target=moved.target, view=names[moved.start], length=length))
    return out


def target_warnings(session: SessionData, sightings: Sightings | None) -> tuple[str, ...]:
    """Return the same problems as sentences."""
    return tuple(found.fix for found in target_problems(session, sightings))


def check_targets(session: SessionData) -> list[SessionProblem]:
    """Return what is wrong with the poses of a session of labelled points; [] if nothing is found.

    First a common move of the base or of all targets. Then, if the poses as stated leave the targets scattered, the
    hypothesis about the poses that leaves clearly less; if there is none, a problem without a cause.
    """
    rows = _tried_rows(len(session.views))
    stated = stated_hypothesis(session, rows)
    capture = _capture_of(session, rows)
    moved = _find_common_move(session, rows, capture)
    if moved is not None:
        return [moved]
    as_stated = _fit_hypothesis(capture, stated)
    limit = max(_LIMIT_M / METRES[session.length_unit], _SHARE_OF_MOTION * _motion_seen(capture))
    if as_stated < limit:
        return []
    tried = _hypotheses_to_try(session, rows, capture, limit)
    spreads = [(h, _fit_hypothesis(capture, h)) for h in tried]
    best, spread = min(spreads, key=lambda pair: pair[1], default=(stated, np.inf))
    if spread > min(_CLEARER * as_stated, limit):
        if as_stated == np.inf:
            return []
        return [problem("unexplained targets", session.names, by=f"{as_stated:.3g} {session.length_unit}")]
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


def _find_common_move(session: SessionData, rows: Indices, capture: Capture) -> SessionProblem | None:
    """Return the problem that from some view on all targets stand elsewhere; None if there is none.

    The move is found among the rows tried. The rows between the two around it say at which view it begins.

    Args:
        rows: numbers of the views in `capture`.
    """
    move = find_common_move(capture)
    if move is None:
        return None
    # Between the last row before it that was tried and the first one after.
    between = np.arange(rows[move.start - 1] + 1, rows[move.start])
    start = int(rows[move.start])
    if len(between):
        start -= int(np.sum(move.shows(_capture_of(session, between))))
    sensor_or_targets = "the tracker" if session.mount == "eye_to_hand" else "all targets together"
    what = f"{sensor_or_targets}, or the robot's base, moved"
    names = session.names
    found = problem("moved", names[start:], what=what, before=names[start - 1], after=names[start])
    return found if move.is_sure else replace(found, certain=False)


def _motion_seen(capture: Capture) -> float:
    """Return the rms distance (length_unit) of targets from their mean in the sensor's frame, over all views.

    It says how far the arm moved; no convention of the poses changes it.
    """
    s = capture.sightings
    assert s is not None
    off = less_group_means(s.points[s.used], s.target[s.used])
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def _hypotheses_to_try(session: SessionData, rows: Indices, capture: Capture, length: float) -> Iterator[Hypothesis]:
    """Yield hypotheses about the poses: those that explain the sensor's motions best, or all; then other units.

    Args:
        rows: numbers of the views in `capture`.
        length: scatter of the targets that counts as good, length_unit; hypotheses closer than a tenth are one.
    """
    assert capture.sightings is not None
    pairs, T_first_second = sensor_motions(capture.sightings)
    motions = RelativeScans(tuple((int(v), int(w)) for v, w in pairs), T_first_second)
    ranked = rank_hypotheses(session, motions, rows)
    if ranked:
        yield from (fit.hypothesis for fit in ranked[:_MAX_HYPOTHESES] if fit.scale == 1.0)
    else:
        yield from distinct(hypotheses(session, rows), 0.1 * length)[1:]
    stated = stated_hypothesis(session, rows)
    for factor, units in UNITS.items():
        T = np.array(stated.T_base_flange)
        T[:, :3, 3] *= factor
        yield stated.undone("sightings", T, factor=factor, units=units)


def _fit_hypothesis(capture: Capture, hypothesis: Hypothesis) -> float:
    """Return the median distance (length_unit) of sightings from the median of their target, under a hypothesis.

    The hand-eye is that in closed form; infinite where there is none, or no target is seen twice.
    """
    s = capture.sightings
    assert s is not None
    if hypothesis.used is not None:
        used = np.isin(np.arange(len(s.points)), hypothesis.used)
        s = replace(s, used=s.used & used[:, None])
    posed = replace(capture, T_reference_mount=hypothesis.T_reference_mount, sightings=s)
    try:
        T_mount = closed_form_hand_eye(posed)
    except (NoResultError, np.linalg.LinAlgError):
        return np.inf
    placed = frames.transform(posed.poses(T_mount), s.points)
    by_target = [placed[s.used & (s.target == k)] for k in range(len(s.targets))]
    distances = [np.linalg.norm(p - np.median(p, axis=0), axis=1) for p in by_target if len(p) > 1]
    return float(np.median(np.concatenate(distances))) if distances else np.inf
