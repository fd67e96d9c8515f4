"""The fit of a rig with the views that belong: fit, examine, leave out what does not belong, and again."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from stitch.errors import NoResultError
from stitch.integrity.admission import ViewScreening, screen_targets, screen_views
from stitch.integrity.refusals import require_majority
from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
from stitch.stages.fitted import FittedRig

# Blunders that hide behind others come out in the next round; three are enough to end or to give up.
_MAX_ROUNDS = 3


@dataclass(frozen=True)
class ScreenedFit:
    """A rig with the views that belong, its fit, and what each session left out."""

    sessions: list[Session]
    measurements: list[Measurement]
    fitted: FittedRig
    screenings: list[ViewScreening]


def fit_screened_views(
    sessions: Sequence[Session],
    measurements: Sequence[Measurement],
    fit: Callable[[Sequence[Session], Sequence[Measurement]], FittedRig],
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
            raise NoResultError(f"{own[short].path}: fewer than two views are left that belong together: {gone}")
    else:
        # The last round has left views out too: what is returned is the fit of those that are left.
        fitted = fit(own, measured)
    return ScreenedFit(own, measured, fitted, taken)


@contextmanager
def _naming_excluded_views(sessions: Sequence[Session], taken: Sequence[ViewScreening]) -> Iterator[None]:
    """Where the views that are left lead nowhere, say which were left out before, and why."""
    try:
        yield
    except NoResultError as error:
        every = zip(sessions, taken, strict=True)
        if not (gone := "; ".join(a.line(session.names) for session, a in every if a.left_out)):
            raise
        raise NoResultError(f"{error}; left out before: {gone}") from error


def _screen_fitted_session(session: Session, fitted: FittedRig, index: int) -> ViewScreening:
    if fitted.correction is not None:
        return screen_views(session, fitted.sessions[index].measurement, fitted.correction, index)
    found = fitted.sessions[index].targets
    # What says nothing about the poses cannot say which of them are wrong.
    return ViewScreening() if found is None else screen_targets(session, found)
