"""`plan`: what the views of a session would tell, and the fewest further ones that bring what is asked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.planning.cells import PlannedCell
from stitch.planning.choose_views import choose_views
from stitch.planning.further_views import candidate_joints, with_views
from stitch.planning.goals import Goal, HalvedHandEye, SplitPair, progress, progress_now
from stitch.planning.outlook import Outlook, in_scanner, outlook
from stitch.planning.view_bed import Bed, bed_of
from stitch.system.threads import library_threads_off

# Fewer views give no hand-eye: two motions about different axes are the least (Tsai & Lenz 1989).
_FEWEST = 3
# Views that are tried; and proposed, beside present ones or where there are none, unless a number is asked for.
_TRIED, _MORE, _ALL = 40, 6, 12
# Effects that would be detected so often at usual size are worth telling apart; so many hard pairs are looked at, and
# what a single view must bring to one of them.
_DETECTED, _PAIRS, _BETTER = 0.5, 6, 0.02


@dataclass(frozen=True)
class Wanted:
    """What further views are for."""

    halve: bool = True
    split: tuple[str, str] | None = None  # None: the hardest pair that views can split
    split_any: bool = True
    views: int | None = None  # at the most
    feature: Array | None = None  # (3,) reference frame


@dataclass(frozen=True)
class Proposed:
    """One further view, and what it and those before it would bring."""

    name: str
    joints: Array  # (n,) rad
    T_base_flange: Array  # (4, 4)
    travel: float  # rad, the largest of all joints, from the view before
    U: float  # of the hand-eye at the part, length_unit; NaN where the hand-eye is not asked for
    apart: float  # share of two rivals' forms that are told apart; NaN where no pair is asked for


@dataclass(frozen=True)
class Plan:
    """What the present views would tell, which to add, and what all of them would tell."""

    session: Session
    assumed: tuple[str, ...]
    now: Outlook | None  # None where there are too few views for a hand-eye
    split: tuple[str, str] | None
    proposed: tuple[Proposed, ...]
    after: Outlook | None  # None where nothing is proposed


def plan(session: Session, planned: PlannedCell, wanted: Wanted) -> Plan:
    """Plan further views of a cell.

    Raises:
        InputError: a pair of effects that these views cannot have.
        NoResultError: views that would not see the part.
    """
    with library_threads_off():
        cell, present = planned.cell, len(session.views)
        now = outlook(session, cell, planned.told, wanted.feature) if present >= _FEWEST else None
        empty = Plan(session, planned.assumed, now, wanted.split, (), None)
        if session.robot is None or session.joints is None or not (wanted.halve or wanted.split or wanted.split_any):
            return empty
        possible = candidate_joints(session, cell, _TRIED)
        if not len(possible):
            return empty
        told = planned.told if now is None else now.told
        bed = bed_of(with_views(session, list(possible), in_turn=False), cell, told.believed if told else cell.scatter)
        goals = _goals(bed, now, wanted)
        joints = np.array([view.joints for view in bed.session.views])
        chosen = choose_views(goals, joints, present, wanted.views or (_ALL if now is None else _MORE)) if goals else []
        if not chosen:
            return empty
        further = with_views(session, [joints[k] for k in chosen])
        after = outlook(further, cell, told, wanted.feature, chances=now is None)
        split = next((goal.names for goal in goals if isinstance(goal, SplitPair)), None)
        return replace(empty, split=split, proposed=_proposed(goals, chosen, further, after.hand_eye.U), after=after)


def _goals(bed: Bed, now: Outlook | None, wanted: Wanted) -> list[Goal]:
    goals = list[Goal]()
    if wanted.halve or now is None:
        channel = bed.channel()
        middle = _middle(bed, wanted.feature)
        goal = HalvedHandEye(channel, middle, float("nan"))
        present = float(goal.U(channel.normal(range(now.views)))) if now else float("nan")
        goals.append(replace(goal, now=present))
    if wanted.split is not None:
        goals.append(_split(bed, wanted.split))
    elif wanted.split_any and now is not None:
        goals += _hardest(bed, now)
    return goals


def _middle(bed: Bed, feature: Array | None) -> Array:
    if feature is not None:
        return in_scanner(bed.found.freed.poses, feature)
    return np.asarray(np.mean([points.mean(axis=0) for points in bed.found.measurement.capture.point_sets], axis=0))


def _split(bed: Bed, names: tuple[str, str]) -> SplitPair:
    a, b = (bed.effect(name) for name in names)
    return SplitPair(bed.channel(names, (a.columns, b.columns)), names, (a, b))


def _hardest(bed: Bed, now: Outlook) -> list[Goal]:
    """The pair of detectable effects that is told apart worst, of those that some view improves."""
    seen = {e.name for e in now.effects if e.chance is not None and e.chance.detected > _DETECTED}
    hard = [pair for pair in now.pairs if {pair.a, pair.b} <= seen and pair.size > 1][:_PAIRS]
    present, others = range(now.views), range(now.views, len(bed.session.views))
    for pair in hard:
        goal = _split(bed, (pair.a, pair.b))
        if progress([goal], present, others).max() > progress_now([goal], present) + _BETTER:
            return [goal]
    return []


def _proposed(goals: Sequence[Goal], chosen: Sequence[int], further: Session, U_after: float) -> tuple[Proposed, ...]:
    """What the views bring one after the other.

    Args:
        U_after: with all of them, of their whole scans; the search has thinner ones.
    """
    present, out = len(further.views) - len(chosen), list[Proposed]()
    for k, view in enumerate(further.views[present:]):
        before = further.views[present + k - 1].joints
        assert view.joints is not None and before is not None
        views = [*range(present), *chosen[: k + 1]]
        U, apart = float("nan"), float("nan")
        for goal in goals:
            normal = goal.channel.normal(views)
            if isinstance(goal, HalvedHandEye):
                U = float(goal.U(normal))
            else:
                apart = float(goal.progress(normal))
        travel = float(np.abs(view.joints - before).max())
        out.append(Proposed(view.name, view.joints, view.T_base_flange, travel=travel, U=U, apart=apart))
    scale = U_after / out[-1].U
    return tuple(replace(view, U=scale * view.U) for view in out)
