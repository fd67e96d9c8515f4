"""`plan`: what the views of a session would tell, and the fewest further ones that bring what is asked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.planning.cells import PlannedCell
from stitch.planning.choose_views import choose_views
from stitch.planning.further_views import candidate_joints, with_views
from stitch.planning.goals import Goal, HalvedHandEye, SplitPair, mean_progress, present_progress
from stitch.planning.outlook import Outlook, feature_in_scanner, view_outlook
from stitch.planning.view_bed import PossibleViews, possible_views
from stitch.system.threads import library_threads_off

# Fewer views give no hand-eye: two motions about different axes are the least (Tsai & Lenz 1989).
_MIN_PRESENT_VIEWS = 3
# Views that are tried; and proposed, beside present ones or where there are none, unless a number is asked for.
_TRIED, _MORE, _ALL = 40, 6, 12
# Effects that would be detected so often at usual size are worth telling apart; so many hard pairs are looked at, and
# what a single view must bring to one of them.
_DETECTED, _PAIRS, _BETTER = 0.5, 6, 0.02


@dataclass(frozen=True)
class PlanRequest:
    """What further views are for."""

    halve: bool = True
    split: tuple[str, str] | None = None  # None: the hardest pair that views can split
    split_any: bool = True
    views: int | None = None  # at the most
    feature: Array | None = None  # (3,) reference frame


@dataclass(frozen=True)
class ProposedView:
    """One further view, and what it and those before it would bring."""

    name: str
    joints: Array  # (n,) rad
    T_base_flange: Array  # (4, 4)
    travel: float  # rad, the largest of all joints, from the view before
    U: float  # of the hand-eye at the part, length_unit; NaN where the hand-eye is not asked for
    separated_share: float  # share of two rivals' forms that are told apart; NaN where no pair is asked for


@dataclass(frozen=True)
class Plan:
    """What the present views would tell, which to add, and what all of them would tell."""

    session: Session
    assumed: tuple[str, ...]
    now: Outlook | None  # None where there are too few views for a hand-eye
    split: tuple[str, str] | None
    proposed: tuple[ProposedView, ...]
    after: Outlook | None  # None where nothing is proposed


def plan_further_views(session: Session, planned: PlannedCell, request: PlanRequest) -> Plan:
    """Plan further views of a cell.

    Raises:
        InputError: a pair of effects that these views cannot have.
        NoResultError: views that would not see the part.
    """
    with library_threads_off():
        cell, present = planned.cell, len(session.views)
        now = (
            view_outlook(session, cell, planned.fitted_scatter, request.feature)
            if present >= _MIN_PRESENT_VIEWS
            else None
        )
        empty = Plan(session, planned.assumed, now, request.split, (), None)
        if session.robot is None or session.joints is None or not (request.halve or request.split or request.split_any):
            return empty
        possible = candidate_joints(session, cell, _TRIED)
        if not len(possible):
            return empty
        told = planned.fitted_scatter if now is None else now.fitted_scatter
        bed = possible_views(
            with_views(session, list(possible), in_turn=False), cell, told.believed if told else cell.scatter
        )
        goals = _plan_goals(bed, now, request)
        joints = np.array([view.joints for view in bed.session.views])
        chosen = (
            choose_views(goals, joints, present, request.views or (_ALL if now is None else _MORE)) if goals else []
        )
        if not chosen:
            return empty
        further = with_views(session, [joints[k] for k in chosen])
        after = view_outlook(further, cell, told, request.feature, chances=now is None)
        split = next((goal.names for goal in goals if isinstance(goal, SplitPair)), None)
        return replace(
            empty, split=split, proposed=_proposed_views(goals, chosen, further, after.hand_eye.U), after=after
        )


def _plan_goals(views: PossibleViews, now: Outlook | None, request: PlanRequest) -> list[Goal]:
    goals = list[Goal]()
    if request.halve or now is None:
        channel = views.channel()
        middle = _uncertainty_point(views, request.feature)
        goal = HalvedHandEye(channel, middle, float("nan"))
        present = float(goal.U(channel.normal(range(now.views)))) if now else float("nan")
        goals.append(replace(goal, now=present))
    if request.split is not None:
        goals.append(_split_goal(views, request.split))
    elif request.split_any and now is not None:
        goals += _hardest_pair_goal(views, now)
    return goals


def _uncertainty_point(views: PossibleViews, feature: Array | None) -> Array:
    if feature is not None:
        return feature_in_scanner(views.simulated.unconstrained.poses, feature)
    return np.asarray(
        np.mean([points.mean(axis=0) for points in views.simulated.measurement.capture.point_sets], axis=0)
    )


def _split_goal(views: PossibleViews, names: tuple[str, str]) -> SplitPair:
    a, b = (views.effect(name) for name in names)
    return SplitPair(views.channel(names, (a.columns, b.columns)), names, (a, b))


def _hardest_pair_goal(views: PossibleViews, now: Outlook) -> list[Goal]:
    """The pair of detectable effects that is told apart worst, of those that some view improves."""
    seen = {e.name for e in now.effects if e.chance is not None and e.chance.detected > _DETECTED}
    hard = [pair for pair in now.pairs if {pair.a, pair.b} <= seen and pair.size > 1][:_PAIRS]
    present, others = range(now.views), range(now.views, len(views.session.views))
    for pair in hard:
        goal = _split_goal(views, (pair.a, pair.b))
        if mean_progress([goal], present, others).max() > present_progress([goal], present) + _BETTER:
            return [goal]
    return []


def _proposed_views(
    goals: Sequence[Goal], chosen: Sequence[int], further: Session, U_after: float
) -> tuple[ProposedView, ...]:
    """What the views bring one after the other.

    Args:
        U_after: with all of them, of their whole scans; the search has thinner ones.
    """
    present, out = len(further.views) - len(chosen), list[ProposedView]()
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
        out.append(ProposedView(view.name, view.joints, view.T_base_flange, travel=travel, U=U, separated_share=apart))
    scale = U_after / out[-1].U
    return tuple(replace(view, U=scale * view.U) for view in out)
