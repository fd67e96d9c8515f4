"""Labelled points that contradict the poses: which convention makes every target one point.

Under each hypothesis about the poses the hand-eye follows in closed form, and the targets' scatter about their middle
judges it: millimetres and less where the convention is right, decimetres where it is wrong.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch.errors import NoResultError
from stitch.frames import Array
from stitch.integrity.conventions import rank_hypotheses
from stitch.integrity.hypotheses import UNITS, Hypothesis, distinct, hypotheses
from stitch.integrity.linkage import names_of_views
from stitch.integrity.problems import SessionProblem
from stitch.integrity.relative_scans import RelativeScans
from stitch.measurement.capture import Capture, build_capture
from stitch.measurement.session import Session
from stitch.measurement.sightings import sightings_of
from stitch.observations.targets.closed_form import closed_form_hand_eye
from stitch.observations.targets.landmarks import fit_rigid_motion
from stitch.units import METRES

# No arm is off by more; a better hypothesis must leave a fifth of what the stated one leaves.
_LIMIT_M, _CLEARER = 0.005, 0.2
# Hypotheses that are fitted in full, and targets in one line.
_MAX_HYPOTHESES, _LINE = 12, 0.02


@dataclass(frozen=True)
class ConventionFit:
    """One hypothesis and how far apart it leaves the sightings of one target."""

    hypothesis: Hypothesis
    spread: float  # median distance from the target's middle, length_unit
    T_mount: Array  # (4, 4)


def check_targets(session: Session) -> list[SessionProblem]:
    """What is wrong with the poses of a session of labelled points; empty if nothing is found."""
    T = np.array([view.T_base_flange for view in session.views])
    capture = build_capture(session.name, (), T, session.mount, sightings_of(session))
    limit = _LIMIT_M / METRES[session.length_unit]
    stated = _fit_hypothesis(capture, Hypothesis("stated", T, session.mount, ""))
    if stated is not None and stated.spread < limit:
        return []
    fits = [
        fit for h in _hypotheses_to_try(session, capture, limit) if (fit := _fit_hypothesis(capture, h)) is not None
    ]
    names = session.names
    best = min(fits, key=lambda fit: fit.spread, default=None)
    before = np.inf if stated is None else stated.spread
    if best is None or best.spread > max(_CLEARER * before, 0.0) or best.spread > limit:
        if stated is None:
            return []
        fix = (
            f"the targets scatter by {stated.spread:.3g} {session.length_unit} under the best hand-eye, and no usual "
            "mistake explains it: check names of targets, rows and how the poses were converted"
        )
        return [SessionProblem("displaced", tuple(names), fix)]
    h = best.hypothesis
    others = [f.hypothesis.fix for f in fits if f.spread < 2 * best.spread and f.hypothesis.fix != h.fix]
    fix = h.fix + (f"; as likely: {'; '.join(dict.fromkeys(others[:2]))}" if others else "")
    return [SessionProblem(h.kind, tuple(names_of_views(h.rows, names)), fix)]


def _hypotheses_to_try(session: Session, capture: Capture, length: float) -> Iterator[Hypothesis]:
    """What to try: where targets show how the sensor moved, the hypotheses that explain its motions best."""
    motions = _sensor_motions(capture)
    ranked = rank_hypotheses(session, motions)
    if ranked:
        yield from (e.hypothesis for e in ranked[:_MAX_HYPOTHESES] if e.scale == 1.0)
        found = hypotheses(session)[:1]
    else:
        found = distinct(hypotheses(session), 1e-3, 0.1 * length)
        yield from found[1:]
    stated = found[0]
    for factor, words in UNITS.items():
        T = np.array(stated.T_base_flange)
        T[:, :3, 3] *= factor
        fix = f"the sightings are {factor:.6g} times as large as the poses say ({words}): check length_unit"
        yield replace(stated, kind="unit", T_base_flange=T, fix=fix)


def _sensor_motions(capture: Capture) -> RelativeScans:
    """Motions of the sensor between views that share three targets or more, by least squares (Kabsch 1976)."""
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
            T.append(fit_rigid_motion(b, a))
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
    apart = []
    for k in range(len(s.targets)):
        here = placed[s.used & (s.target == k)]
        if len(here) > 1:
            apart.append(np.linalg.norm(here - np.median(here, axis=0), axis=1))
    return ConventionFit(hypothesis, float(np.median(np.concatenate(apart))), T_mount) if apart else None
