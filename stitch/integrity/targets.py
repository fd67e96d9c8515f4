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
from stitch.integrity.hypotheses import UNITS, Hypothesis, distinct, hypotheses
from stitch.integrity.linkage import only
from stitch.integrity.problems import Problem
from stitch.measurement.capture import Capture, place
from stitch.measurement.session import Session
from stitch.measurement.sightings import sightings_of
from stitch.observations.targets.closed_form import closed_form
from stitch.units import METRES

# No arm is off by more; a better hypothesis must leave a fifth of what the stated one leaves.
_LIMIT_M, _CLEARER = 0.005, 0.2


@dataclass(frozen=True)
class TargetFit:
    """One hypothesis and how far apart it leaves the sightings of one target."""

    hypothesis: Hypothesis
    off: float  # median distance from the target's middle, length_unit
    T_mount: Array  # (4, 4)


def check_targets(session: Session) -> list[Problem]:
    """What is wrong with the poses of a session of labelled points; empty if nothing is found."""
    T = np.array([view.T_base_flange for view in session.views])
    capture = place(session.name, (), T, session.mount, sightings_of(session))
    limit = _LIMIT_M / METRES[session.length_unit]
    stated = _fit(capture, Hypothesis("stated", T, session.mount, ""))
    if stated is not None and stated.off < limit:
        return []
    fits = [fit for h in _tried(session, limit) if (fit := _fit(capture, h)) is not None]
    names = [view.name for view in session.views]
    best = min(fits, key=lambda fit: fit.off, default=None)
    before = np.inf if stated is None else stated.off
    if best is None or best.off > max(_CLEARER * before, 0.0) or best.off > limit:
        if stated is None:
            return []
        fix = (
            f"the targets scatter by {stated.off:.3g} {session.length_unit} under the best hand-eye, and no usual "
            "mistake explains it: check names of targets, rows and how the poses were converted"
        )
        return [Problem("displaced", tuple(names), fix)]
    h = best.hypothesis
    others = [f.hypothesis.fix for f in fits if f.off < 2 * best.off and f.hypothesis.fix != h.fix]
    fix = h.fix + (f"; as likely: {'; '.join(dict.fromkeys(others[:2]))}" if others else "")
    return [Problem(h.kind, tuple(only(h.rows, names)), fix)]


def _tried(session: Session, length: float) -> Iterator[Hypothesis]:
    found = distinct(hypotheses(session), 1e-3, 0.1 * length)
    yield from found[1:]
    stated = found[0]
    for factor, words in UNITS.items():
        T = np.array(stated.T_base_flange)
        T[:, :3, 3] *= factor
        fix = f"the sightings are {factor:.6g} times as large as the poses say ({words}): check length_unit"
        yield replace(stated, kind="unit", T_base_flange=T, fix=fix)


def _fit(capture: Capture, hypothesis: Hypothesis) -> TargetFit | None:
    """The closed form under a hypothesis; None where it has none."""
    s = capture.sightings
    assert s is not None
    if hypothesis.used is not None:
        out = np.setdiff1d(np.arange(len(s.points)), hypothesis.used)
        s = replace(s, used=s.used & ~np.isin(np.arange(len(s.points)), out)[:, None])
    own = replace(capture, T_reference_mount=hypothesis.T_reference_mount, sightings=s)
    try:
        T_mount = closed_form(own)
    except (NoResultError, np.linalg.LinAlgError):
        return None
    placed = frames.transform(own.poses(T_mount), s.points)
    apart = []
    for k in range(len(s.targets)):
        here = placed[s.used & (s.target == k)]
        if len(here) > 1:
            apart.append(np.linalg.norm(here - np.median(here, axis=0), axis=1))
    return TargetFit(hypothesis, float(np.median(np.concatenate(apart))), T_mount) if apart else None
