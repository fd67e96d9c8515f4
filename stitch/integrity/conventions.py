"""Which convention of the poses explains how the scanner moved: A·X = X·B under every hypothesis.

The motions B come from the scans alone (`relative_scans.py`), A from the poses with one mistake undone. A hypothesis
is judged by the motions that close under its best hand-eye (`motion_fit.py`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch.integrity.between_rows import poses_between_rows
from stitch.integrity.hypotheses import UNITS, Hypothesis, distinct, hypotheses
from stitch.integrity.motion_fit import FEWEST, TRANSLATION_M, MotionFit, fit_motions, screen_hypotheses
from stitch.integrity.parts_of_tables import hypotheses_by_table_part
from stitch.integrity.relative_scans import RelativeScans
from stitch.integrity.stuck_columns import restore_stuck_columns
from stitch.measurement.session import Session
from stitch.units import METRES

# A hypothesis closes if this share of the motions does; and it must leave clearly less open than another to be told
# from it: (1 − score) counts open motions.
_MIN_CLOSED_SHARE = 0.6
_CLEARER, _CLEAR_OPEN = 0.6, 0.02
# Short of that: this share under one reading, and under the stated one so little of it that chance does as much.
_MANY_CLOSED, _FEW_CLOSED, _AS_MANY = 0.4, 0.2, 0.75
# Poses whose motions nearly all close need no other convention.
_ALL = 0.95
# A factor is one between units if it is this near.
_UNIT_NEAR = 0.05


def rank_hypotheses(session: Session, motions: RelativeScans) -> list[MotionFit]:
    """All hypotheses about the poses of a session, best first; empty if the scans show too little motion."""
    if len(motions.pairs) < FEWEST:
        return []
    length = TRANSLATION_M / METRES[session.length_unit]
    tried = hypotheses(session)
    out = [
        fit_motions(tried[0], motions, length),
        _other_length_unit(fit_motions(tried[0], motions, length, scaled=True)),
    ]
    if out[0].closed < _ALL:
        tried += restore_stuck_columns(out[0], motions, length)
        tried += poses_between_rows(tried[0], motions, length)
        tried += hypotheses_by_table_part(tried, motions, session.names)
        out += fit_hypotheses(tried, motions, session.length_unit)[1:]
    return sorted(out, key=lambda e: (e.open, e.hypothesis.kind != "stated"))


def fit_hypotheses(
    tried: Sequence[Hypothesis], motions: RelativeScans, length_unit: str, *, scaled: bool = False
) -> list[MotionFit]:
    """What could close of some hypotheses, the first always, in their order; those that move alike are one.

    Args:
        scaled: fit the scale of the robot's lengths too.
    """
    if len(motions.pairs) < FEWEST:
        return []
    length = TRANSLATION_M / METRES[length_unit]
    kept = distinct(screen_hypotheses(tried, motions), 1e-3, 1e-3 * length)
    return [fit_motions(h, motions, length, scaled=scaled) for h in kept]


def equivalent_hypotheses(found: Sequence[MotionFit]) -> list[MotionFit]:
    """The hypotheses that these motions cannot tell from the best, best first; empty if none explains them."""
    ranked = sorted(found, key=lambda e: e.open)
    if not ranked or ranked[0].closed < _MIN_CLOSED_SHARE:
        return []
    return [e for e in ranked if e.open <= ranked[0].open / _CLEARER + _CLEAR_OPEN]


def proven_hypotheses(found: Sequence[MotionFit]) -> tuple[MotionFit, ...]:
    """The hypotheses that explain the motions as well as any, if the poses as stated do not; () if they do."""
    if not found:
        return ()
    stated = next(e for e in found if e.hypothesis.kind == "stated" and e.scale == 1.0)
    best = found[0]
    if stated.open <= best.open / _CLEARER + _CLEAR_OPEN or best.closed < _MIN_CLOSED_SHARE:
        return ()
    close = [e for e in found if e.open <= best.open / _CLEARER + 0.01 and e.closed >= 0.9 * best.closed]
    return tuple(e for e in close if e.hypothesis.kind != "stated" or e.scale != 1.0)


def likeliest_hypotheses(found: Sequence[MotionFit]) -> tuple[MotionFit, ...]:
    """The readings that agree with many motions where the stated one agrees with hardly any; () if none does.

    Less than `verdict` asks for: a part that slides on itself closes half of the motions under any reading. So it is
    for sessions of which views are accused anyway.
    """
    if not found:
        return ()
    stated = max(e.closed for e in found if e.hypothesis.kind == "stated" and e.scale == 1.0)
    most = max(e.closed for e in found)
    if most < _MANY_CLOSED or stated > _FEW_CLOSED * most:
        return ()
    return tuple(sorted((e for e in found if e.closed >= _AS_MANY * most), key=lambda e: -e.closed))


def _other_length_unit(found: MotionFit) -> MotionFit:
    """The stated poses with another unit of length."""
    s = found.scale
    h = found.hypothesis
    if s <= 0:
        return replace(found, open=1.0, closed=0.0)
    factor = min(UNITS, key=lambda u: abs(np.log(s / u)))
    if abs(s / factor - 1) < _UNIT_NEAR:
        fix = (
            f"the clouds are {factor:.6g} times as large as the poses say ({UNITS[factor]}): "
            "check cloud_unit and length_unit"
        )
        return replace(found, hypothesis=replace(h, kind="unit", fix=fix))
    fix = f"the clouds are {s:.5g} times as large as the robot's motions say: check their scale"
    return replace(found, hypothesis=replace(h, kind="scale", fix=fix))
