"""Sessions that no run may use: poses that contradict the scans, another mount's model, too few views that belong."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

import numpy as np

from stitch import frames
from stitch.errors import InputError, NoResultError
from stitch.frames import Array
from stitch.integrity.arm_limits import beyond_any_arm, contradiction_in_words
from stitch.integrity.deep_check import deep_check
from stitch.integrity.problems import SessionProblem
from stitch.integrity.snooping import Snooping
from stitch.integrity.view_names import list_views
from stitch.measurement.capture import Capture
from stitch.measurement.session import Session
from stitch.observations.surfaces.free_poses import unconstrained_poses
from stitch.observations.surfaces.hand_eye import fit_hand_eye
from stitch.runs.run import ExcludedView
from stitch.stages.correction import Correction
from stitch.statistics.tails import chi2_limit

# A hand-eye that differs by chance alone is refused once in a million.
_OWN_MODEL_CHANCE = 1e-6
# Views that show two motions, the fewest that a hand-eye follows from.
_MOTIONS = 3
# From this share of the views on, a mistake of the whole session is looked for; a part that was clamped anew, or scans
# that changed places, leave many views out and a good rest.
_MAX_EXCLUDED_SHARE = 1 / 3
_SINGLE_VIEW_KINDS = ("displaced", "disconnected", "foreign", "duplicate_scan", "duplicate_pose")
_KINDS_LEAVING_A_REST = ("reclamped", "exchanged")


def refuse(session: Session, problems: Sequence[SessionProblem]) -> None:
    """Raise what a deep check found; nothing where it found nothing certain."""
    for problem in (p for p in problems if p.certain):
        kind = NoResultError if problem.kind in ("displaced", "disconnected") else InputError
        raise kind(f"{session.path}: the poses contradict what was measured: {problem.line(session.names)}")


def refuse_whole(session: Session) -> list[SessionProblem]:
    """Refuse a mistake of the whole session, such as a wrong order of angles.

    Returns:
        What else a deep check found.

    Raises:
        InputError: there is one.
    """
    found = deep_check(session)
    refuse(session, [p for p in found if p.kind not in (*_SINGLE_VIEW_KINDS, *_KINDS_LEAVING_A_REST)])
    return found


@contextmanager
def refuse_explained_mistake(session: Session) -> Iterator[None]:
    """Where views do not overlap, refuse the mistake of the whole session that explains it, if there is one.

    Raises:
        InputError: there is one.
        NoResultError: as it was raised inside.
    """
    try:
        yield
    except NoResultError:
        # That nothing overlaps under any hand-eye says no more than what was said already.
        with suppress(NoResultError):
            refuse_whole(session)
        raise


def require_majority(session: Session, left_out: Sequence[ExcludedView]) -> None:
    """Refuse a session of which so many views do not belong that the rest cannot say which of them are wrong.

    Args:
        session: with all its views.

    Raises:
        InputError: a usual mistake explains it.
        NoResultError: none does, and half of the views or more do not belong.
    """
    if len(left_out) < _MAX_EXCLUDED_SHARE * len(session.views):
        return
    found = refuse_whole(session)
    if 2 * len(left_out) >= len(session.views) and not any(p.kind in _KINDS_LEAVING_A_REST for p in found):
        gone = {item.view for item in left_out}
        names = list_views([name for name in session.names if name in gone], session.names)
        raise NoResultError(
            f"{session.path}: {len(left_out)} of {len(session.views)} views ({names}) do not belong to the others, and "
            "which half is right nobody can say; to fix: check that rows and clouds belong together and how the poses "
            "were converted"
        )


def require_own_model(session: Session, correction: Correction, index: int) -> None:
    """Refuse a model whose hand-eye is off by more than any arm moves it, as these scans clearly show."""
    own, T_mount = correction.captures[index], correction.model.T_mount
    fitted = fit_hand_eye([own], [correction.unconstrained[index]], T_mount)
    turn, shift = _hand_eye_difference(own, T_mount, fitted.T_mount)
    if not beyond_any_arm(session, turn, shift):
        return
    # Views freed from far off are only on their way, and what they lack would count as scatter: once more from there.
    freed = unconstrained_poses(own, own.poses(fitted.T_mount), correction.overlaps[index].gate)
    fitted = fit_hand_eye([own], [freed], fitted.T_mount)
    turn, shift = _hand_eye_difference(own, T_mount, fitted.T_mount)
    xi = frames.log(frames.inverse(T_mount) @ fitted.T_mount)
    clear = xi @ np.linalg.solve(fitted.covariance + correction.model.covariance, xi) > chi2_limit(_OWN_MODEL_CHANCE, 6)
    if clear and beyond_any_arm(session, turn, shift):
        raise NoResultError(
            f"{session.path}: the model's hand-eye is {shift:.3g} {session.length_unit} and {1e3 * turn:.3g} mrad off "
            "what these scans say: it belongs to another mount, scanner or unit; to fix: run without --hand-eye"
        )


def require_two_motions(session: Session) -> None:
    """Refuse two views from which no hand-eye was found: one motion leaves two directions of it open.

    Raises:
        NoResultError: there are no more.
    """
    if len(session.views) < _MOTIONS:
        raise NoResultError(
            f"{session.path}: two views show one motion, and no hand-eye was found from it that brings them together; "
            "to fix: add views turned about another axis, or take the hand-eye of another run (--hand-eye RUN)"
        )


def unexplained_error(session: Session, found: Snooping) -> NoResultError:
    off = contradiction_in_words(session, found)
    return NoResultError(
        f"{session.path}: the poses contradict the scans by {off}, more than any arm, and no usual mistake explains "
        "it; to fix: check that rows and clouds belong together and how the poses were converted"
    )


def _hand_eye_difference(own: Capture, T_mount: Array, other: Array) -> tuple[float, float]:
    """Angle (rad) between two hand-eyes, and how far they put the part from each other."""
    xi = frames.log(frames.inverse(T_mount) @ other)
    middle = np.mean([scan.points.mean(axis=0) for scan in own.scans], axis=0)
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:] + np.cross(xi[:3], middle)))
