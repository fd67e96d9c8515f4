"""Which views of a run may be fused: blunders named and left out, contradictions beyond any arm refused."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from stitch.errors import NoResultError
from stitch.fit.correct import Correction
from stitch.fit.fit import FittedRig
from stitch.numerics.frames import Array
from stitch.observations.targets.target_model import TargetModelFit
from stitch.run_data import ExcludedView, ViewLinks
from stitch.screening.deep_check import (
    apply_displacement_limits,
    beyond_any_arm,
    deep_check,
    displacement_in_words,
    poses_contradict_scans,
    refuse,
    refuse_whole,
    require_majority,
    require_own_model,
    require_two_motions,
    scatter_is_doubtful,
    snooping_warnings,
    unexplained_error,
)
from stitch.screening.pairing import explain_misplaced
from stitch.screening.pose_tests import MAX_VIEWS_WITH_EFFECTS, length_problem
from stitch.screening.problems import SessionProblem, list_views
from stitch.screening.snooping import MisplacedView, Snooping, snoop_views
from stitch.screening.target_checks import check_targets, target_warnings
from stitch.screening.view_model import UsualEffects
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData, View
from stitch.system.process import announce


@dataclass(frozen=True)
class ViewScreening:
    """What may be fused of one session."""

    left_out: tuple[ExcludedView, ...] = ()
    suspected: tuple[ExcludedView, ...] = ()  # off by no more than an effect of an arm may cause: fused, and noted
    links: ViewLinks = field(default_factory=ViewLinks)
    doubts: tuple[str, ...] = ()  # of the session as a whole, as sentences

    @property
    def names(self) -> set[str]:
        """Names of the views that are left out."""
        return {item.view for item in self.left_out}

    def line(self, order: Sequence[str]) -> str:
        """Return what was left out and why; `order` has the names of all views."""
        why = dict.fromkeys(item.why for item in self.left_out)
        groups = {w: [item.view for item in self.left_out if item.why == w] for w in why}
        return "; ".join(f"{list_views(views, order)}: {w}" for w, views in groups.items())

    def indices(self, session: SessionData) -> list[int]:
        """Return the indices of the views that are left out."""
        return [v for v, view in enumerate(session.views) if view.name in self.names]


def screen_views(session: SessionData, measurement: Measurement, correction: Correction, index: int) -> ViewScreening:
    """Examine the views of one session of a rig under a corrected model.

    Args:
        index: of the session in the rig.

    Raises:
        InputError: the poses contradict the scans beyond any arm, and a usual mistake explains it.
        NoResultError: they do, and none does; or two views alone do; or groups of views share no surface.
    """
    own, T_mount = correction.captures[index], correction.geometry.T_mount
    if correction.given:
        require_own_model(session, correction, index)
    announce("checking every view against the others")
    found = _snoop_session(session, measurement, correction, index)
    if poses_contradict_scans(session, found):
        if not correction.given:
            require_two_motions(session)
        refuse(session, deep_check(session))
        raise unexplained_error(session, found)
    size = length_problem(found.model, own.T_reference_mount, found.blunder_search.mean_columns)
    if size is not None:
        # Other mistakes look like a factor on lengths too.
        refuse(session, [size if problem.kind == size.kind else problem for problem in deep_check(session)])
        refuse(session, [size])
    if scatter_is_doubtful(session, found):
        # Poses contradict the scans as no arm of use does: a mistake of all of them is refused.
        refuse_whole(session)
    warnings = (*target_warnings(session, own.sightings), *snooping_warnings(session, own, found, T_mount))
    if not any(beyond_any_arm(session, *step.at_least) for step in found.steps):
        # A slip of the part, or a knock of the mount, within what a model can hold: said, and left to the diagnosis.
        found = replace(found, steps=())
    problems = explain_misplaced(session, own, T_mount, found) if found.left_out else []
    apart = next((p for p in problems if p.kind == "disconnected"), None)
    if apart is not None:
        raise NoResultError(f"{session.path}: {apart.line(session.names)}")
    out = _excluded_views(session, own, found, T_mount, problems)
    return ViewScreening(
        left_out=out,
        suspected=tuple(_suspected_view(session, own, m, T_mount) for m in found.suspected),
        links=_view_links(session, found),
        doubts=warnings,
    )


def session_warnings(
    session: SessionData, measurement: Measurement, correction: Correction | None, index: int
) -> tuple[str, ...]:
    """Return the warnings of a session as a whole under a model, whose views were screened before.

    Args:
        correction: of surfaces; None where there are none.
    """
    targets = target_warnings(session, measurement.capture.sightings)
    if correction is None:
        return targets
    announce("checking every view against the others")
    found = _snoop_session(session, measurement, correction, index)
    return (*targets, *snooping_warnings(session, correction.captures[index], found, correction.geometry.T_mount))


def _snoop_session(session: SessionData, measurement: Measurement, correction: Correction, index: int) -> Snooping:
    usual, gate = UsualEffects(measurement, correction.geometry), correction.overlaps[index].gate
    found = snoop_views(
        correction.captures[index], correction.geometry.T_mount, gate, correction.unconstrained[index], usual
    )
    if len(session.views) >= MAX_VIEWS_WITH_EFFECTS:
        # Held against white scatter alone, since what arms do takes minutes there: what they do looks like steps.
        large = (step for step in found.steps if beyond_any_arm(session, *step.at_least))
        found = replace(found, steps=tuple(large))
    return apply_displacement_limits(session, found)


def screen_targets(session: SessionData, found: TargetModelFit) -> ViewScreening:
    """Labelled points: outliers are taken out one by one; poses that contradict them all are refused.

    Raises:
        InputError: a usual mistake explains it.
        NoResultError: none does.
    """
    rotation, translation = np.sqrt(found.variances[:2])
    if beyond_any_arm(session, rotation, translation):
        refuse(session, check_targets(session))
    return ViewScreening(doubts=target_warnings(session, found.rows.sightings))


def _suspected_view(session: SessionData, own: Capture, found: MisplacedView, T_mount: Array) -> ExcludedView:
    view = session.views[found.view]
    return ExcludedView(
        view.name, displacement_in_words(session, found), own.poses(T_mount)[found.view], _point_count(view)
    )


_NO_SURFACE = "it shares no surface with the others; to fix: add views that overlap with it"


def _excluded_views(
    session: SessionData, own: Capture, found: Snooping, T_mount: Array, problems: Sequence[SessionProblem]
) -> tuple[ExcludedView, ...]:
    poses = own.poses(T_mount)
    out = []
    for v in found.left_out:
        name = session.views[v].name
        why = next((p.line(session.names) for p in problems if name in p.views), _NO_SURFACE)
        out.append(ExcludedView(name, why, poses[v], _point_count(session.views[v])))
    return tuple(out)


def _point_count(view: View) -> int:
    return 0 if view.cloud is None else view.cloud.count


def _view_links(session: SessionData, found: Snooping) -> ViewLinks:
    names = session.names
    return ViewLinks(
        components=tuple(tuple(names[v] for v in part) for part in found.linkage.components),
        weak=tuple((names[v], names[w]) for v, w in found.linkage.single),
    )


# The fit of a rig with the views that belong: fit, examine, leave out what does not belong, and again.

# Blunders that hide behind others come out in the next round; three are enough to end or to give up.
_MAX_ROUNDS = 3


@dataclass(frozen=True)
class ScreenedFit:
    """A rig with the views that belong, its fit, and what each session left out."""

    sessions: list[SessionData]
    measurements: list[Measurement]
    fitted: FittedRig
    screenings: list[ViewScreening]


def fit_screened_views(
    sessions: Sequence[SessionData],
    measurements: Sequence[Measurement],
    fit: Callable[[Sequence[SessionData], Sequence[Measurement]], FittedRig],
    keep: bool = False,
) -> ScreenedFit:
    """Fit all sessions with the views that belong.

    Args:
        keep: name views that do not belong, but leave them in.

    Raises:
        InputError: poses contradict the scans, and a usual mistake explains it.
        NoResultError: they do, and none does; too few views are left; groups of views share no surface.
    """
    own, measured = list(sessions), list(measurements)
    taken = [ViewScreening() for _ in own]
    for _ in range(_MAX_ROUNDS):
        with _naming_excluded_views(sessions, taken):
            fitted = fit(own, measured)
            found = [_screen_fitted_session(session, fitted, i) for i, session in enumerate(own)]
        taken = [replace(new, left_out=(*old.left_out, *new.left_out)) for old, new in zip(taken, found, strict=True)]
        if keep or not any(a.left_out for a in found):
            break
        for session, a in zip(sessions, taken, strict=True):
            require_majority(session, a.left_out)
        measured = [m.without(a.indices(s)) for m, a, s in zip(measured, found, own, strict=True)]
        own = [s.without(a.names) for s, a in zip(own, found, strict=True)]
        short = next((i for i, s in enumerate(own) if len(s.views) < 2), None)
        if short is not None:
            gone = taken[short].line(sessions[short].names)
            raise NoResultError(f"{own[short].path}: fewer than two views belong together ({gone}); to fix: add views")
    else:
        # The last round has left views out too: what is returned is the fit of those that are left.
        fitted = fit(own, measured)
    return ScreenedFit(own, measured, fitted, taken)


@contextmanager
def _naming_excluded_views(sessions: Sequence[SessionData], taken: Sequence[ViewScreening]) -> Iterator[None]:
    """Where the views that are left lead nowhere, say which were left out before, and why."""
    try:
        yield
    except NoResultError as error:
        every = zip(sessions, taken, strict=True)
        if not (gone := "; ".join(a.line(session.names) for session, a in every if a.left_out)):
            raise
        raise NoResultError(f"{error}; left out before: {gone}") from error


def _screen_fitted_session(session: SessionData, fitted: FittedRig, index: int) -> ViewScreening:
    if fitted.correction is not None:
        return screen_views(session, fitted.sessions[index].measurement, fitted.correction, index)
    found = fitted.sessions[index].targets
    # What says nothing about the poses cannot say which of them are wrong.
    return ViewScreening() if found is None else screen_targets(session, found)
