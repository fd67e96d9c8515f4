"""`plan`: what the views of a session would tell, and the fewest further ones that bring what is asked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.candidate_views import drawn_until, reachable
from stitch.diagnosis.candidates import free_masks
from stitch.diagnosis.score import weights_of_masks
from stitch.diagnosis.thresholds import SEPARATION_LAMBDA
from stitch.effects.contract import find_effect, require_available
from stitch.model.model import COVERAGE_FACTOR, sizes_of, term_of
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import equilibrated
from stitch.observations.pose_errors import prior_pose_errors
from stitch.observations.surfaces.effect_columns import view_columns, view_responses
from stitch.observations.surfaces.hand_eye_fit import hand_eye_jacobian
from stitch.observations.surfaces.scanner_errors import field_scatter, smooth_errors
from stitch.plugins.metrology.planning.detection_chances import Outlook, view_outlook
from stitch.plugins.metrology.planning.expected_model import (
    FEWEST,
    CellModel,
    PlannedCell,
    Scatter,
    SimulatedViews,
    expected_scans,
    simulate_views,
    thinned_surface,
)
from stitch.plugins.metrology.planning.information import TwistChannel, noise_of, separations
from stitch.session.axis_poses import carried_last, reported_poses
from stitch.session.capture import build_capture
from stitch.session.robot import forward
from stitch.session.session import SessionData, View
from stitch.system.threads import library_threads_off
from stitch.system.values import Table

# Points on the part and correspondences of a view are few here: there are many pairs, and noise is not what limits.
_SAMPLES = 250
_POINTS = 4000
_MIN_VIEW_SAMPLES = 25
# Keeps what too few views leave open finite: a radian, and many times any part.
_OPEN = 1e-8
# Of a feature so small a share of U is asked for that every view counts that brings something.
_MUCH = 0.1
# Whatever the unit, no logarithm of a length comes near.
_NEVER = -50.0
# Reached, but for rounding; and what a view must bring to be worth taking.
_REACHED = 1 - 1e-6
_WORTH = 0.01
# Among views that bring nearly the same the nearest is taken.
_NEARLY = 0.95
_SWEEPS = 2
# Fewer views give no hand-eye: two motions about different axes are the least (Tsai & Lenz 1989).
_MIN_PRESENT_VIEWS = 3
# A joint's way from a pose out of reach to one that may be in reach, rad.
_NEAR_REFUSED = 0.1
# Views that are tried; and proposed, beside present ones or where there are none, unless a number is asked for.
_TRIED = 40
_MORE = 6
_ALL = 12
# For one feature as many are tried again, so many times, close to those that were chosen.
_CLOSER = 2
# Effects that would be detected so often at usual size are worth telling apart; so many hard pairs are looked at, and
# what a single view must bring to one of them.
_DETECTED = 0.5
_PAIRS = 6
_BETTER = 0.02
# A view must show this share of what the others show.
_SHARE = 0.4
# So many times as many poses are tried as are asked for.
_TRIES = 4
# More poses are drawn until there are this share of those that are asked for.
_ENOUGH = 1 / 6


@dataclass(frozen=True)
class PossibleViews:
    """N views: those of the session first, then those that could be added."""

    session: SessionData
    cell: CellModel
    simulated: SimulatedViews
    scatter: Scatter  # with the errors of the arm that the views are expected to leave open

    def channel(self, foreign_effects: Sequence[str] = (), columns: Sequence[Array] = ()) -> TwistChannel:
        """Hand-eye, a common motion, effects in use, further columns; `foreign_effects` are such as no arm has of
        itself."""
        m = self.simulated.measurement
        unconstrained = self.simulated.unconstrained
        model = self.cell.model
        g = unconstrained.overlaps.gram
        errors = prior_pose_errors([m], model, [g.centre])
        errors = errors.restricted(errors.causes - set(foreign_effects))
        sizes = self.scatter.variances(errors.names)
        covariance = np.einsum("c,cij->ij", sizes[3:], errors.components) + self._white()
        field = field_scatter(smooth_errors(m, unconstrained), unconstrained)
        covariance += field @ field.T
        # Of every view against all others.
        information = np.zeros((g.views, 6, 6))
        for side in (0, 1):
            np.add.at(information, g.pairs[:, side].astype(np.int64), g.matrix)
        covariance += noise_of(information, sizes[2] * g.variance, max(g.lever, 1e-9))
        used = view_columns(m, model, unconstrained) * sizes_of(model.terms)
        common = np.tile(np.eye(6), (g.views, 1))
        hand_eye = hand_eye_jacobian(m.capture, model.T_mount, g.centre)
        return TwistChannel(covariance, np.hstack([hand_eye, common, used, *columns]))

    def effect(self, name: str) -> tuple[Array, Array, Array]:
        """Return how the views answer to an effect of the library: columns (6N, P) at plausible sizes, the forms that
        it may have (F, P) bool, parameters that are free, and each one's share of the prior (F,).

        Raises:
            InputError: one that is not known, or that these views cannot have.
        """
        measurement, effect = self.simulated.measurement, find_effect(name)
        require_available(measurement, effect)
        term = term_of(measurement, effect)
        response = view_responses(measurement, self.cell.model, [term], self.simulated.unconstrained)[0].columns
        masks = free_masks(term)
        return response * term.typical, np.array(masks), weights_of_masks(masks)

    def _white(self) -> Array:
        """(6N, 6N) of the flange's scatter, view by view."""
        m = self.simulated.measurement
        to_centre = frames.make(np.eye(3), -self.simulated.unconstrained.overlaps.gram.centre)
        carried = frames.adjoint(to_centre @ m.capture.T_reference_flange)
        size = np.repeat([self.scatter.rotation**2, self.scatter.translation**2], 3)
        out = np.zeros((len(carried), 6, len(carried), 6))
        each = np.arange(len(carried))
        out[each, :, each] = (carried * size) @ carried.transpose(0, 2, 1)
        return out.reshape(6 * len(carried), -1)


@dataclass(frozen=True)
class KnownPlace:
    """U of a place, down to a share of what the present views give it."""

    channel: TwistChannel
    lever: Array  # (n, q) of the place in the channel's parameters
    now: float  # U of the present views, length_unit; NaN where they give none
    share: float = 0.5

    def U(self, normal: Array) -> Array:
        """(...) of normal matrices (..., q, q)."""
        scaled, unit = equilibrated(normal)
        inverse = np.linalg.inv(scaled + _OPEN * np.eye(normal.shape[-1]))
        lever = self.lever * unit[..., None, :]
        return COVERAGE_FACTOR * np.sqrt(np.einsum("...ia,...ab,...ib->...", lever, inverse, lever))

    def progress(self, normal: Array) -> Array:
        """(...) 1 where U has come down to that share; without a present U what its logarithm falls by, never 1."""
        if not np.isfinite(self.now):
            return _NEVER - np.log(self.U(normal))
        return np.clip(np.log(self.U(normal) / self.now) / np.log(self.share), 0.0, 1.0)


def place_lever(place: Array, width: int, start: int = 0) -> Array:
    """(3, width) by which parameters move a place (3,): a twist, in six columns from `start` on."""
    lever = np.zeros((3, width))
    lever[:, start : start + 6] = np.hstack([-frames.skew(place), np.eye(3)])
    return lever


@dataclass(frozen=True)
class SplitPair:
    """Two effects of usual size, each told from the other."""

    channel: TwistChannel
    names: tuple[str, str]
    forms: tuple[Array, Array]  # (F, P) bool of each: parameters that are free; their columns are the channel's last
    weights: tuple[Array, Array]  # (F,) share of the prior of each form

    def progress(self, normal: Array) -> Array:
        """(...) share of the forms that are told apart, of the effect that is told worse; 1 if all are."""
        middle = normal.shape[-1] - self.forms[1].shape[1]
        a = slice(middle - self.forms[0].shape[1], middle)
        b = slice(middle, normal.shape[-1])
        shares = []
        for pattern, rival, forms, weights in zip((a, b), (b, a), self.forms, self.weights, strict=True):
            apart = separations(normal, pattern, rival) @ forms.T
            shares.append(np.minimum(apart / SEPARATION_LAMBDA, 1.0) @ weights)
        return np.minimum(*shares)


Goal = KnownPlace | SplitPair


def mean_progress(goals: Sequence[Goal], chosen: Sequence[int], others: Sequence[int]) -> Array:
    """(K,) mean progress of all goals with each of some more views."""
    return np.mean([goal.progress(goal.channel.with_each(chosen, others)) for goal in goals], axis=0)


def present_progress(goals: Sequence[Goal], chosen: Sequence[int]) -> float:
    """Return the mean progress of the chosen views alone."""
    return float(np.mean([goal.progress(goal.channel.normal(chosen)) for goal in goals]))


def choose_views(goals: Sequence[Goal], joints: Array, present: int, most: int, worth: float = _WORTH) -> list[int]:
    """Indices of further views, in the order in which they are driven.

    Args:
        joints: (N, n) of all views: those that are there first.
        present: how many these are.
        most: views at the most.
        worth: progress that a view must bring.
    """
    before = list(range(present))
    chosen = list[int]()
    now = present_progress(goals, before)
    while len(chosen) < most and now < _REACHED:
        others = [k for k in range(present, len(joints)) if k not in chosen]
        if not others:
            break
        gained = mean_progress(goals, [*before, *chosen], others)
        if gained.max() - now < worth:
            break
        # Of those that bring nearly the most, the one that is nearest to the view before.
        good = np.flatnonzero(gained - now >= _NEARLY * (gained.max() - now))
        last = joints[[*before, *chosen][-1]]
        k = others[int(good[np.argmin([float(np.abs(joints[others[int(i)]] - last).sum()) for i in good])])]
        chosen.append(k)
        now = float(gained[others.index(k)])
    for _ in range(_SWEEPS):
        chosen, now = _exchange_views(goals, joints, before, chosen, now)
    return travel_order(joints, present - 1, _without_redundant(goals, before, chosen, now))


def _exchange_views(
    goals: Sequence[Goal], joints: Array, before: list[int], chosen: list[int], now: float
) -> tuple[list[int], float]:
    """Every chosen view against the best in its place."""
    for i in range(len(chosen)):
        rest = chosen[:i] + chosen[i + 1 :]
        others = [k for k in range(len(before), len(joints)) if k not in rest]
        gained = mean_progress(goals, [*before, *rest], others)
        best = int(gained.argmax())
        if gained[best] > now + _WORTH:
            chosen, now = [*rest[:i], others[best], *rest[i:]], float(gained[best])
    return chosen, now


def _without_redundant(goals: Sequence[Goal], before: list[int], chosen: list[int], now: float) -> list[int]:
    """Without the views that the others make idle."""
    for k in list(chosen):
        rest = [other for other in chosen if other != k]
        if rest and present_progress(goals, [*before, *rest]) >= min(now, _REACHED):
            chosen = rest
    return chosen


def travel_order(joints: Array, last: int, chosen: Sequence[int]) -> list[int]:
    """Views of joint angles (V, n), each the nearest to the one before, beginning at the view `last`."""
    order = list[int]()
    left = list(chosen)
    at = last
    while left:
        at = min(left, key=lambda k: float(np.abs(joints[k] - joints[at]).sum()))
        left.remove(at)
        order.append(at)
    return order


@dataclass(frozen=True)
class PlanRequest:
    """What further views are for."""

    halve: bool = True
    split: tuple[str, str] | None = None  # None: the hardest pair that views can split
    split_any: bool = True
    views: int | None = None  # at the most
    feature: Array | None = None  # (3,) reference frame; or (6,) with the direction that counts
    poses: Array | None = None  # (K, n) rad that a diagnosis proposes for this very pair: no others are sought
    refused: Array | None = None  # (K, n) rad that the arm cannot reach: nothing near them is tried
    worth: float = _WORTH  # progress that a view must bring

    @property
    def place(self) -> Array | None:
        """(3,) of the feature, reference frame."""
        return None if self.feature is None else self.feature[:3]


def plan_request(views: int | None, split: tuple[str, str] | None, halve: bool, feature: Array | None) -> PlanRequest:
    """Return what is asked: without a word both to halve U and to split the hardest pair.

    Raises:
        InputError: an effect that is not known.
    """
    for name in split or ():
        find_effect(name)
    return PlanRequest(halve or split is None, split, not halve and feature is None, views, feature)


@dataclass(frozen=True)
class ProposedView:
    """One further view, and what it and those before it would bring."""

    name: str
    joints: Array  # (n,) rad
    T_base_flange: Array  # (4, 4)
    travel: float  # rad, the largest of all joints, from the view before
    U: float  # of the hand-eye at the part, or of the feature's place, length_unit; NaN where neither is asked for
    separated_share: float  # share of two rivals' forms that are told apart; NaN where no pair is asked for


@dataclass(frozen=True, eq=False)
class Plan(Table, table="proposed"):
    """What the present views would tell, which to add, and what all of them would tell.

    Example:
        >>> plan = stitch.plan(run, views=2)
        >>> plan.now.views, [view.name for view in plan.proposed], plan.after.views
        (5, ['p01', 'p02'], 7)
        >>> plan.proposed[0].joints.shape, plan.proposed[0].T_base_flange.shape
        ((6,), (4, 4))
    """

    session: SessionData
    assumed: tuple[str, ...]
    now: Outlook | None  # None where there are too few views for a hand-eye
    split: tuple[str, str] | None
    proposed: tuple[ProposedView, ...]
    after: Outlook | None  # None where nothing is proposed
    place_now: float | None = None  # U of the feature's place by the present views, length_unit; None: not asked for


def plan_further_views(session: SessionData, planned: PlannedCell, request: PlanRequest) -> Plan:
    """Plan further views of a cell.

    Raises:
        InputError: a pair of effects that these views cannot have.
        NoResultError: views that would not see the part.
    """
    with library_threads_off():
        cell = planned.cell
        enough = len(session.views) >= _MIN_PRESENT_VIEWS
        now = view_outlook(session, cell, planned.fitted_scatter, request.place) if enough else None
        empty = Plan(session, planned.assumed, now, request.split, (), None)
        if session.robot is None or session.joints is None or not (request.halve or request.split or request.split_any):
            return empty
        errors = planned.fitted_scatter if now is None else now.fitted_scatter
        goals, chosen, joints = _search_views(session, cell, errors.believed if errors else cell.scatter, now, request)
        if not chosen:
            return empty
        further = with_views(session, list(joints))
        after = view_outlook(further, cell, errors, request.place, chances=now is None)
        if now is not None and request.halve and request.split is None and after.hand_eye.U > now.hand_eye.U:
            # Views that would make it no better than it is are none to take.
            return empty
        split = next((goal.names for goal in goals if isinstance(goal, SplitPair)), None)
        ends = None if now is None else now.hand_eye.U, after.hand_eye.U
        place_now = next((goal.now for goal in goals if isinstance(goal, KnownPlace) and np.isfinite(goal.now)), None)
        return replace(
            empty,
            split=split,
            proposed=_proposed_views(goals, chosen, further, None if request.feature is not None else ends),
            after=after,
            place_now=None if request.feature is None else place_now,
        )


def best_further_view(session: SessionData, planned: PlannedCell, refused: Sequence[Array] = ()) -> Array | None:
    """Return joints (n,) rad of the one further view that makes the hand-eye surest; None where none sees the part.

    However little it is expected to bring: of few views the arm's scatter is hardly known, and a view may show it less.

    Args:
        refused: joints (n,) that the arm cannot reach.

    Raises:
        NoResultError: views that would not see the part.
    """
    errors = planned.fitted_scatter
    request = PlanRequest(split_any=False, views=1, refused=np.array(refused) if refused else None, worth=0.0)
    with library_threads_off():
        scatter = errors.believed if errors else planned.cell.scatter
        _, chosen, joints = _search_views(session, planned.cell, scatter, None, request)
    return joints[0] if chosen else None


def _search_views(
    session: SessionData, cell: CellModel, scatter: Scatter, now: Outlook | None, request: PlanRequest
) -> tuple[list[Goal], list[int], Array]:
    """Return goals over all views that were tried, the indices of the C chosen ones there, and their joints (C, n)."""
    assert session.joints is not None
    coarse = replace(cell, part=thinned_surface(cell.part.points, cell.part.normals, _POINTS))
    if request.poses is not None:
        every = with_views(session, list(request.poses))
        simulated = simulate_views(every, coarse, _SAMPLES, _MIN_VIEW_SAMPLES)
        goals = _plan_goals(PossibleViews(every, coarse, simulated, scatter), now, request)
        return goals, list(range(len(session.views), len(every.views))), request.poses
    goals, chosen, joints = list[Goal](), list[int](), session.joints[:0]
    for _ in range(1 if request.feature is None else 1 + _CLOSER):
        tried = np.vstack([joints, candidate_joints(session, cell, _TRIED, joints if chosen else None)])
        if request.refused is not None:
            tried = tried[np.abs(tried[:, None] - request.refused).max(axis=2).min(axis=1) > _NEAR_REFUSED]
        if not len(tried):
            break
        every = with_views(session, list(tried), in_turn=False)
        simulated = simulate_views(every, coarse, _SAMPLES, _MIN_VIEW_SAMPLES)
        goals = _plan_goals(PossibleViews(every, coarse, simulated, scatter), now, request)
        possible = np.array([view.joints for view in every.views])
        most = request.views or (_ALL if now is None else _MORE)
        chosen = choose_views(goals, possible, len(session.views), most, request.worth) if goals else []
        if not chosen:
            break
        joints = possible[chosen]
    return goals, chosen, joints


def _plan_goals(views: PossibleViews, now: Outlook | None, request: PlanRequest) -> list[Goal]:
    goals = list[Goal]()
    if request.halve or now is None:
        goal = _place_goal(views, request)
        present = float(goal.U(goal.channel.normal(range(now.views)))) if now else float("nan")
        goals.append(replace(goal, now=present))
    if request.split is not None:
        goals.append(_split_goal(views, request.split))
    elif request.split_any and now is not None:
        goals += _hardest_pair_goal(views, now)
    return goals


def _place_goal(views: PossibleViews, request: PlanRequest) -> KnownPlace:
    """The hand-eye at the middle of the field; or, of a feature, where the part lies: what all views share."""
    channel = views.channel()
    width = channel.columns.shape[1]
    if request.feature is None:
        return KnownPlace(channel, place_lever(views.simulated.field_middle(), width), float("nan"))
    centre = views.simulated.unconstrained.overlaps.gram.centre
    lever = place_lever(request.feature[:3] - centre, width, start=6)
    if len(request.feature) > 3:
        lever = request.feature[None, 3:] / np.linalg.norm(request.feature[3:]) @ lever
    return KnownPlace(channel, lever, float("nan"), _MUCH)


def _split_goal(views: PossibleViews, names: tuple[str, str]) -> SplitPair:
    columns, forms, weights = zip(*(views.effect(name) for name in names), strict=True)
    return SplitPair(views.channel(names, columns), names, forms, weights)


def _hardest_pair_goal(views: PossibleViews, now: Outlook) -> list[Goal]:
    """The pair of detectable effects that is told apart worst, of those that some view improves."""
    detected = {e.name for e in now.effects if e.chance is not None and e.chance.detected > _DETECTED}
    hard = [pair for pair in now.pairs if {pair.a, pair.b} <= detected and pair.size > 1][:_PAIRS]
    present = range(now.views)
    others = range(now.views, len(views.session.views))
    for pair in hard:
        goal = _split_goal(views, (pair.a, pair.b))
        if mean_progress([goal], present, others).max() > present_progress([goal], present) + _BETTER:
            return [goal]
    return []


def _proposed_views(
    goals: Sequence[Goal],
    chosen: Sequence[int],
    further: SessionData,
    ends: tuple[float | None, float] | None,
) -> tuple[ProposedView, ...]:
    """Return what the views bring one after the other.

    Args:
        ends: U of the hand-eye before them, if known, and with all, of whole scans and of the fit that a run does; the
            search has thinner ones and weighs as it knows the arm, and says what share each brings. None: of a place.
    """
    present, out = len(further.views) - len(chosen), list[ProposedView]()
    start = next((goal.now for goal in goals if isinstance(goal, KnownPlace)), float("nan"))
    reported = reported_poses(further)
    for k, view in enumerate(further.views[present:]):
        from_here = further.views[present + k - 1].joints
        assert view.joints is not None and from_here is not None
        views = [*range(present), *chosen[: k + 1]]
        U, apart = float("nan"), float("nan")
        for goal in goals:
            normal = goal.channel.normal(views)
            if isinstance(goal, KnownPlace):
                U = float(goal.U(normal))
            else:
                apart = float(goal.progress(normal))
        travel = float(np.abs(view.joints - from_here).max())
        T = reported[present + k]
        out.append(ProposedView(view.name, view.joints, T, travel=travel, U=U, separated_share=apart))
    if ends is None:
        return tuple(out)
    before, after = ends
    last = out[-1].U
    if before is None or not last < start:
        return tuple(replace(view, U=after / last * view.U) for view in out)
    shares = [np.log(view.U / start) / np.log(last / start) for view in out]
    return tuple(replace(v, U=float(before * (after / before) ** share)) for v, share in zip(out, shares, strict=True))


def with_views(session: SessionData, joints: Sequence[Array], in_turn: bool = True) -> SessionData:
    """The session with further views at joint angles (n,) rad, after the last one, called p01, p02 …

    Args:
        in_turn: each driven to from the one before; else each from the last view that there is, one of them being next.
    """
    assert session.robot is not None
    last, views = session.views[-1], list(session.views)
    # External axes stay where they were last.
    carried = carried_last(session)
    times = [view.time_s for view in views if view.time_s is not None]
    pause = float(np.median(np.diff(times))) if len(times) > 1 else 60.0
    for k, q in enumerate(joints):
        before = views[-1] if in_turn else last
        assert before.joints is not None
        # As alternatives they come at times that a few views would take.
        later = pause * (k + 1 if in_turn else k % 6 + 1)
        views.append(
            View(
                name=f"p{k + 1:02d}",
                cloud=None,
                T_base_flange=carried[0] @ forward(session.robot, q),
                joints=q,
                approach=np.sign(q - before.joints),
                time_s=None if last.time_s is None else last.time_s + later,
                covariates=dict(last.covariates),
            )
        )
    return replace(session, views=tuple(views))


def candidate_joints(session: SessionData, cell: CellModel, count: int, chosen: Array | None = None) -> Array:
    """(K, n) joint angles near those that are planned, or closer to chosen ones (C, n), in which the scanner would see
    the part, K ≤ count."""
    T_mount = cell.model.T_mount
    driven, T_base_flange = session.joints, np.array([view.T_base_flange for view in session.views])
    assert driven is not None

    def poses_of(joints: Array) -> Array:
        assert session.robot is not None
        T = carried_last(session) @ forward(session.robot, joints)
        return build_capture(session.name, (), T, session.mount).poses(T_mount)

    seen_from = build_capture(session.name, (), T_base_flange, session.mount).poses(T_mount)
    least = max(FEWEST, _SHARE * np.median([len(index) for index in expected_scans(cell, seen_from)]))

    def seeing(seed: int) -> Array:
        """Return random joint angles (k, n) in which the scanner would see enough of the part."""
        joints = reachable(driven, poses_of, seen_from, cell.part.centre, chosen, seed)[: _TRIES * count]
        return joints[[len(index) >= least for index in expected_scans(cell, poses_of(joints))]]

    # About a single view the part is hardly ever in its place again: random angles are drawn anew then.
    return drawn_until(seeing, _ENOUGH * count)[:count]
