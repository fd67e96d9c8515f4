"""A jump in time that is a joint turning back as well: a path that was driven once shows both at the same view."""

from dataclasses import replace

import numpy as np

from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.verdict import Evidence
from stitch.measurement.measurement import Views

# The effect of the direction from which a joint comes.
_BY_DIRECTION = "backlash"
# Share of a joint's moves on either side of a jump that go one way, and the moves there must be to tell.
_ONE_WAY, _FEWEST_MOVES = 0.95, 3


def joints_turning_at(views: Views, first: float) -> list[int]:
    """Return the joints, counted from 1, that come from one side before a view and from the other side from there on.

    Args:
        first: number of the view, as events count it.
    """
    out, after = list[int](), views.number >= first
    for joint, side in enumerate(views.approach.T, 1):
        sides = [side[now & (side != 0)] for now in (~after, after)]
        if min(map(len, sides)) < _FEWEST_MOVES:
            continue
        # 1 where all moves go one way, −1 where all go the other.
        before, later = (2 * np.mean(own > 0) - 1 for own in sides)
        if before * later < 0 and min(abs(before), abs(later)) >= 2 * _ONE_WAY - 1:
            out.append(joint)
    return out


def with_turning_joints(views: Views, evidence: Evidence) -> Evidence:
    """Add to a jump that is named the joints that turn back where it happens: this session cannot tell the two apart.

    A jump that is missing beside other effects is not added with them.
    """
    if evidence.verdict != "missing_effect":
        return evidence
    named, found = evidence.named[0], {r.name: _coincidence(views, r) for r in (*evidence.named, *evidence.together)}
    rest = tuple(r for r in evidence.together if not found[r.name])
    notes = (*evidence.notes, *(text for name, text in found.items() if text and name != named.name))
    if not found[named.name]:
        return replace(evidence, together=rest, further=evidence.further and next(iter(rest[1:]), None), notes=notes)
    rival = next((r for r in evidence.ranked if r.name == _BY_DIRECTION and r.score.observable), None)
    if rival is None:
        return replace(evidence, unnamed_explains_it=True, notes=(found[named.name], *notes))
    return replace(
        evidence, explanation=(named, rival), further=None, together=(), notes=notes, coincidence=found[named.name]
    )


def _coincidence(views: Views, ranked: Ranked) -> str:
    """Return what else begins where an effect jumps; empty where it does not, or nothing does."""
    event = next((p for p in ranked.score.form.term.parameters if p.discrete), None)
    joints = joints_turning_at(views, event.value) if event is not None else []
    if event is None or not joints:
        return ""
    which = f"joint {joints[0]} comes" if len(joints) == 1 else f"joints {', '.join(map(str, joints))} come"
    return f"{ranked.name} begins at view {event.view}, and from there on {which} from the other side"
