"""Which views of a run may be fused: blunders named and left out, contradictions beyond any arm refused.

A rig is fitted, its views are examined, what does not belong is left out, and the rest is fitted again.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from stitch.errors import NoResultError
from stitch.fit.correct import Correction
from stitch.fit.fit import FittedRig
from stitch.numerics.frames import Array
from stitch.observations.targets.target_model import TargetModelFit
from stitch.run_data import ExcludedView, HandEyeTransfer, ViewLinks
from stitch.screening.deep_check import deep_check, refuse, refuse_contradiction, refuse_whole, require_majority
from stitch.screening.hypotheses import sentence
from stitch.screening.model_transfer import require_matching_hand_eye
from stitch.screening.pairing import explain_misplaced
from stitch.screening.plausibility import (
    apply_displacement_limits,
    beyond_any_arm,
    poses_contradict_scans,
    scatters_beyond_effects,
    snooping_warnings,
    suspicion_in_words,
)
from stitch.screening.pose_tests import MAX_VIEWS_WITH_EFFECTS, length_problem
from stitch.screening.problems import list_views
from stitch.screening.snooping import Snooping, snoop_views
from stitch.screening.stock import find_stock, stock_problems
from stitch.screening.target_checks import check_targets, target_warnings
from stitch.screening.view_model import UsualEffects
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement
from stitch.session.scan import Stock
from stitch.session.session import SessionData
from stitch.system.process import announce

# Blunders that hide behind others come out in the next round; three are enough to end or to give up.
_MAX_ROUNDS = 3


@dataclass(frozen=True)
class ViewScreening:
    """What may be fused of one session."""

    left_out: tuple[ExcludedView, ...] = ()
    suspected: tuple[ExcludedView, ...] = ()  # off by no more than an effect of an arm may cause: fused, and noted
    links: ViewLinks = field(default_factory=ViewLinks)
    doubts: tuple[str, ...] = ()  # of the session as a whole, as sentences
    hand_eye: HandEyeTransfer | None = None  # of a given one, against that of the views
    stock: Mapping[int, Stock | None] = field(default_factory=dict)  # taken off before anything else is asked

    @property
    def names(self) -> set[str]:
        """Names of the views that are left out."""
        return {item.view for item in self.left_out}

    def line(self, order: Sequence[str]) -> str:
        """Return what was left out and why; `order` has the names of all views."""
        reasons = dict.fromkeys(item.why for item in self.left_out)
        views = {why: [item.view for item in self.left_out if item.why == why] for why in reasons}
        return "; ".join(f"{list_views(views[why], order)}: {why}" for why in reasons)


@dataclass(frozen=True)
class ScreenedFit:
    """A rig with the views that belong, its fit, and what each session left out."""

    sessions: list[SessionData]
    measurements: list[Measurement]
    fitted: FittedRig
    screenings: list[ViewScreening]

    def with_doubts(self, doubts: Sequence[tuple[str, ...]]) -> "ScreenedFit":
        """Return the same with further doubts of each session."""
        every = zip(self.screenings, doubts, strict=True)
        return replace(self, screenings=[replace(a, doubts=(*a.doubts, *further)) for a, further in every])


def fit_screened_views(
    sessions: Sequence[SessionData],
    measurements: Sequence[Measurement],
    fit: Callable[[Sequence[SessionData], Sequence[Measurement]], FittedRig],
    keep: bool = False,
) -> ScreenedFit:
    """Return the fit of a rig with the views that belong, and per session what was left out and why.

    Fit and screening alternate: stock is taken off first, then views that do not belong are left out, until none is,
    or for `_MAX_ROUNDS` rounds.

    Args:
        fit: fits sessions from their measurements.
        keep: report views that do not belong, but use them.

    Raises:
        InputError: poses contradict the scans, and a usual mistake explains it.
        NoResultError: they do, and none does; too few views are left; groups of views share no surface.
    """
    remaining = list(sessions)
    measured = list(measurements)
    # Of all rounds together.
    found = [ViewScreening() for _ in sessions]
    for _ in range(_MAX_ROUNDS):
        with _naming_excluded_views(sessions, found):
            fitted, screenings = _fit_and_screen(remaining, measured, fit)
            while any(screening.stock for screening in screenings):
                measured = [
                    replace(m, capture=m.capture.without_stock(screening.stock))
                    for m, screening in zip(measured, screenings, strict=True)
                ]
                fitted, screenings = _fit_and_screen(remaining, measured, fit)
        found = [
            replace(new, left_out=(*old.left_out, *new.left_out)) for old, new in zip(found, screenings, strict=True)
        ]
        if keep or not any(screening.left_out for screening in screenings):
            break
        for session, screening in zip(sessions, found, strict=True):
            require_majority(session, screening.left_out)
        for i, (session, screening) in enumerate(zip(remaining, screenings, strict=True)):
            left_out = [v for v, name in enumerate(session.names) if name in screening.names]
            measured[i] = measured[i].without(left_out)
        remaining = [session.without(screening.names) for session, screening in zip(remaining, screenings, strict=True)]
        short = next((i for i, session in enumerate(remaining) if len(session.views) < 2), None)
        if short is not None:
            why = found[short].line(sessions[short].names)
            path = remaining[short].path
            raise NoResultError(f"{path}: fewer than two views belong together ({why}); to fix: add views")
    else:
        # The last round has left views out too: what is returned is the fit of those that remain.
        fitted = fit(remaining, measured)
    return ScreenedFit(remaining, measured, fitted, found)


def _fit_and_screen(
    sessions: Sequence[SessionData],
    measurements: Sequence[Measurement],
    fit: Callable[[Sequence[SessionData], Sequence[Measurement]], FittedRig],
) -> tuple[FittedRig, list[ViewScreening]]:
    """Return the fit of a rig, and per session what may be fused under it."""
    fitted = fit(sessions, measurements)
    return fitted, [_screen_session(session, fitted, i) for i, session in enumerate(sessions)]


@contextmanager
def _naming_excluded_views(sessions: Sequence[SessionData], taken: Sequence[ViewScreening]) -> Iterator[None]:
    """Add to the message of a NoResultError raised inside which views were left out before, and why.

    Args:
        taken: per session what was left out so far.
    """
    try:
        yield
    except NoResultError as error:
        every = zip(sessions, taken, strict=True)
        if not (gone := "; ".join(a.line(session.names) for session, a in every if a.left_out)):
            raise
        raise NoResultError(f"{error}; left out before: {gone}") from error


def _screen_session(session: SessionData, fitted: FittedRig, index: int) -> ViewScreening:
    """Return what may be fused of session `index` of a rig: by its scans, or else by its labelled points."""
    if fitted.correction is not None:
        return screen_views(session, fitted.sessions[index].measurement, fitted.correction, index)
    targets = fitted.sessions[index].targets
    # What says nothing about the poses cannot say which of them are wrong.
    return ViewScreening() if targets is None else screen_targets(session, targets)


def screen_views(session: SessionData, measurement: Measurement, correction: Correction, index: int) -> ViewScreening:
    """Return which views of one session of a rig may be fused under a corrected model, or refuse the session.

    What concerns all views is tested before single views, since it makes good ones look wrong: a hand-eye of another
    set-up; stock; mistakes of the table of poses. Stock is returned alone: the caller takes it off and calls again.

    Args:
        measurement: of the session.
        correction: hand-eye and views of the whole rig.
        index: of the session in the rig.

    Raises:
        InputError: the poses contradict the scans beyond any arm, and a usual mistake explains it.
        NoResultError: they do, and none does; or two views alone do; or groups of views share no surface.
    """
    capture = correction.captures[index]
    if correction.given:
        require_matching_hand_eye(session, measurement, correction, index)
    snooping = _snoop_session(session, measurement, correction, index)
    if stock := find_stock(session, snooping):
        return ViewScreening(stock=stock)
    if poses_contradict_scans(session, snooping):
        refuse_contradiction(session, snooping, given=correction.given)
    wrong_lengths = length_problem(snooping.model, capture.T_reference_mount, snooping.blunder_search.mean_columns)
    if wrong_lengths is not None:
        # Other mistakes look like a factor on lengths too: those are refused first, under their own names.
        refuse(session, [wrong_lengths if p.kind == wrong_lengths.kind else p for p in deep_check(session)])
        refuse(session, [wrong_lengths])
    if scatters_beyond_effects(session, snooping):
        # Poses contradict the scans as no arm of use does: a mistake of all of them is refused.
        refuse_whole(session)
    # Before small steps are dropped: the warnings tell of them.
    doubts = _whole_session_warnings(session, capture, snooping)
    snooping = _without_small_steps(session, snooping)
    # Of few views the warnings weigh all poses together: no single one is suspected beside that.
    suspected = snooping.suspected if snooping.few is None else ()
    names = session.names
    poses = capture.poses(snooping.T_mount)
    return ViewScreening(
        left_out=_misplaced_views(session, snooping, poses),
        suspected=tuple(_excluded_view(session, m.view, suspicion_in_words(session, m), poses) for m in suspected),
        links=ViewLinks(
            components=tuple(tuple(names[v] for v in part) for part in snooping.linkage.components),
            weak=tuple((names[v], names[w]) for v, w in snooping.linkage.only_links),
        ),
        doubts=doubts,
    )


def _whole_session_warnings(session: SessionData, capture: Capture, snooping: Snooping) -> tuple[str, ...]:
    """Return the warnings of a session as a whole: its targets, stock, copied scans, and what the tests of views say.

    Of two scans with the same points one may be left out: then they are no copies.

    Args:
        capture: of the session, without the effects in use.
        snooping: what the tests say.
    """
    of_stock = (problem.fix for problem in stock_problems(session, capture))
    left_out = _without_small_steps(session, snooping).left_out
    kept = [v for v in range(len(capture.scans)) if v not in left_out]
    copies = [
        (v, w) for v, w in combinations(kept, 2) if np.array_equal(capture.scans[v].points, capture.scans[w].points)
    ]
    of_copies = (sentence("copies", views=f"{session.names[v]} and {session.names[w]}") for v, w in copies)
    return *target_warnings(session, capture.sightings), *of_stock, *of_copies, *snooping_warnings(session, snooping)


def _without_small_steps(session: SessionData, snooping: Snooping) -> Snooping:
    """Return what the tests say without steps, unless one is beyond what any arm does.

    A slip of the part, or a knock of the mount, that effects can describe is left to the diagnosis: no view beyond it
    is left out.
    """
    is_large = any(beyond_any_arm(session, *step.at_least) for step in snooping.steps)
    return snooping if is_large else replace(snooping, steps=())


def _misplaced_views(session: SessionData, snooping: Snooping, poses: Array) -> tuple[ExcludedView, ...]:
    """Return the views that are left out, each with the reason.

    Args:
        poses: (V, 4, 4) T_reference_scanner of all views under the model.

    Raises:
        NoResultError: the views are groups that share no surface.
    """
    problems = explain_misplaced(session, snooping) if snooping.left_out else []
    separate_groups = next((problem for problem in problems if problem.mistake == "groups"), None)
    if separate_groups is not None:
        raise NoResultError(f"{session.path}: {separate_groups.line(session.names)}")
    # A view with several problems has the reason of the first.
    why = {name: problem.line(session.names) for problem in reversed(problems) for name in problem.views}
    return tuple(
        _excluded_view(session, v, why.get(session.names[v], sentence("alone")), poses) for v in snooping.left_out
    )


def _excluded_view(session: SessionData, v: int, why: str, poses: Array) -> ExcludedView:
    view = session.views[v]
    return ExcludedView(view.name, why, poses[v], 0 if view.cloud is None else view.cloud.count)


def screen_targets(session: SessionData, targets: TargetModelFit) -> ViewScreening:
    """Return the warnings about a session's labelled points; no view is left out.

    Poses that scatter beyond any arm are checked for mistakes, and refused if one is certain. Single outliers were
    taken out by the fit.

    Raises:
        InputError: a usual mistake explains it.
        NoResultError: none does.
    """
    rotation, translation = np.sqrt(targets.variances[:2])
    problems = check_targets(session) if beyond_any_arm(session, rotation, translation) else []
    refuse(session, problems)
    return ViewScreening(doubts=(*(p.fix for p in problems), *target_warnings(session, targets.rows.sightings)))


def session_warnings(
    session: SessionData, measurement: Measurement, correction: Correction | None, index: int
) -> tuple[str, ...]:
    """Return the warnings of a session as a whole under a model, whose views were screened before.

    Args:
        correction: of surfaces; None where there are none.
    """
    if correction is None:
        return target_warnings(session, measurement.capture.sightings)
    snooping = _snoop_session(session, measurement, correction, index)
    return _whole_session_warnings(session, correction.captures[index], snooping)


def _snoop_session(session: SessionData, measurement: Measurement, correction: Correction, index: int) -> Snooping:
    """Return what the tests say about the views of session `index` of a rig.

    In sessions of `MAX_VIEWS_WITH_EFFECTS` views or more, only steps beyond what any arm does are kept.
    """
    announce("checking every view against the others")
    snooping = snoop_views(
        correction.captures[index],
        correction.geometry.T_mount,
        correction.unconstrained[index],
        UsualEffects(measurement, correction.geometry),
    )
    if len(session.views) >= MAX_VIEWS_WITH_EFFECTS:
        # There steps were tested against white scatter alone, and errors that follow the pose look like steps.
        large = [step for step in snooping.steps if beyond_any_arm(session, *step.at_least)]
        snooping = replace(snooping, steps=tuple(large))
    return apply_displacement_limits(session, snooping)
