"""Find what is wrong with a session without a run (`stitch check --deep`), and refuse or warn of it in a run."""

import csv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace

import numpy as np

from stitch.errors import InputError, NoResultError
from stitch.fit.coarse import find_coarse_hand_eye
from stitch.fit.correct import Correction, icp_hand_eye
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.distributions import chi2_limit, chi2_tail
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES, angle_text, length_text
from stitch.observations.pose_errors import usual_twist
from stitch.observations.surfaces.hand_eye_fit import fit_hand_eye
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.observations.targets.outliers import drop_mislabelled
from stitch.run_data import ExcludedView
from stitch.screening.conventions import (
    MotionFit,
    SurfaceFit,
    hypotheses_by_surface,
    likeliest_hypotheses,
    proven_hypotheses,
    rank_hypotheses,
    register_scan_pairs,
)
from stitch.screening.hypotheses import known_unit_ratio
from stitch.screening.pairing import explain_misplaced
from stitch.screening.pose_tests import FEWEST_DEGREES, length_problem
from stitch.screening.problems import SessionProblem, displacement_text, likeliest_text, list_views, names_of_views
from stitch.screening.rounding import Rounding, find_rounding
from stitch.screening.scan_faults import find_occluder, find_static_background
from stitch.screening.snooping import MisplacedView, Snooping, snoop_views
from stitch.screening.target_checks import check_targets, target_problems
from stitch.screening.view_model import UsualEffects
from stitch.session.capture import Capture, part_size, sightings_of
from stitch.session.measurement import measurement_of
from stitch.session.reading.depth_image import DEPTH_SUFFIXES
from stitch.session.reading.intrinsics import find_intrinsics
from stitch.session.session import SessionData
from stitch.session.thinning import thin_session

# No arm scatters by more.
_ROTATION, _TRANSLATION_M = 0.010, 0.005
# No effect of an arm is believed to displace a single view by more than half of that.
_VIEW_ROTATION, _VIEW_M = 0.005, 0.0025


def apply_displacement_limits(session: SessionData, found: Snooping) -> Snooping:
    """Return the findings with those suspected views misplaced that are surely off by more than effects of an arm."""
    sure = [m for m in found.suspected if _beyond_effects(session, *m.at_least)]
    return replace(
        found,
        misplaced=tuple(sorted((*found.misplaced, *sure), key=lambda m: m.view)),
        suspected=tuple(m for m in found.suspected if m not in sure),
    )


def _beyond_effects(session: SessionData, rotation: float, translation: float) -> bool:
    """True if no effect of an arm is believed to displace a single view so far."""
    return rotation > _VIEW_ROTATION or translation * METRES[session.length_unit] > _VIEW_M


def poses_contradict_scans(session: SessionData, found: Snooping) -> bool:
    """True if the poses contradict the scans beyond what any arm does."""
    lost = len(found.not_belonging) > len(session.views) / 2
    return lost or beyond_any_arm(session, found.rotation, found.translation)


def scatter_is_doubtful(session: SessionData, found: Snooping) -> bool:
    """True if all poses together scatter by what no arm is believed to do to a single view."""
    return _beyond_effects(session, found.rotation, found.translation)


def beyond_any_arm(session: SessionData, rotation: float, translation: float) -> bool:
    """True if a rotation (rad) or a translation (length_unit) is larger than what any arm does."""
    return rotation > _ROTATION or translation > _TRANSLATION_M / METRES[session.length_unit]


def displacement_in_words(session: SessionData, found: MisplacedView) -> str:
    """Return how far a suspected view is off, in words."""
    amount = displacement_text(found.at_least, found.at_least, session.length_unit)
    return f"is off by at least {amount}" if amount else "is off by an amount that its surface does not show"


def _contradiction_in_words(session: SessionData, found: Snooping) -> str:
    """Return the scatter by which the poses contradict the scans, in words."""
    return f"{1e3 * found.rotation:.3g} mrad and {found.translation:.3g} {session.length_unit}"


def background_problems(session: SessionData, own: Capture, T_mount: Array, found: Snooping) -> list[SessionProblem]:
    """Return the problems of what the scans show beside the part: static background, or what only one scan shows.

    Args:
        T_mount: (4, 4) hand-eye under which `found` was made.
    """
    size, names = part_size([own]), session.names
    still = find_static_background(own.scans, own.poses(T_mount), found.tolerance, size)
    if still is not None:
        return [SessionProblem("foreign", names_of_views(still.views, names), still.describe(session.length_unit))]
    if found.left_out or found.steps:
        # The part itself stands elsewhere where a view is off; without that view it is asked again.
        return []
    stray = find_occluder(own.scans, found.unconstrained.poses, size)
    return [SessionProblem("foreign", names_of_views(stray.views, names), stray.describe(names))] if stray else []


# So many views leave too few degrees of freedom for their scatter to accuse one of them.
_FEW_VIEWS = 5
_NUMBERS = {2: "two", 3: "three", 4: "four", 5: "five"}
# Chance that poses which repeat as those of arms do are said to disagree.
_FEW_VIEWS_CHANCE = 1e-4


def check_few_views(session: SessionData, found: Snooping) -> str | None:
    """Return a warning of few views whose poses disagree by more than arms repeat, or that nothing can be tested by.

    They show few motions: that something is wrong, but not which scan, row or effect. None where poses agree, or where
    the views are enough for each to be tested by the others.
    """
    views, unit = len(session.views), session.length_unit
    count, degrees = _NUMBERS.get(views, str(views)), found.blunder_search.null_projector.degrees
    if (views > _FEW_VIEWS and degrees >= FEWEST_DEGREES) or found.left_out or found.suspected:
        return None
    if degrees < 1:
        return (
            f"No test says whether these {count} views belong together, since one hand-eye brings any together; "
            "to fix: add views."
        )
    rotation, translation = usual_twist(unit)[[0, 3]]
    if _global_model_test(found, np.array([rotation**2, translation**2, 1.0])):
        return None
    by = f"{length_text(found.translation, unit, 2)} and {angle_text(found.rotation, 2)}"
    usual = f"{length_text(translation, unit, 2)} and {angle_text(rotation, 2)}"
    return (
        f"{count.capitalize()} poses contradict their scans by {by}, where arms repeat to about {usual}: a scan, a row "
        f"or the arm is off; to fix: add views, since {count} do not show which."
    )


def _global_model_test(found: Snooping, variances: Array) -> bool:
    """Test the model as a whole (Baarda 1968): the scatter is known and not taken from the same data."""
    mixed = found.model.mixed()
    C, A, z = mixed.covariance(variances)[0], mixed.A[0], mixed.z[0]
    CA, Cz = np.linalg.solve(C, A), np.linalg.solve(C, z)
    statistic = z @ Cz - Cz @ A @ np.linalg.solve(A.T @ CA, A.T @ Cz)
    return chi2_tail(float(statistic), len(z) - A.shape[1]) > _FEW_VIEWS_CHANCE


# Rounding explains a scatter of no more than so many times what it makes, and no less than its part.
_TIMES_ROUNDING = 2.0


def rounding_that_explains(session: SessionData, found: Snooping) -> Rounding | None:
    """Return the rounding of the table's rotations, if it turns poses by more than arms do and as much as they scatter.

    It is asked before rows are blamed: no row of such a table is wrong.
    """
    rounded = find_rounding(np.array([view.T_base_flange for view in session.views]))
    if rounded is None or rounded.rotation < usual_twist(session.length_unit)[0]:
        return None
    as_much = rounded.rotation / _TIMES_ROUNDING < found.rotation < _TIMES_ROUNDING * rounded.rotation
    return rounded if as_much else None


_LISTED = 3


def snooping_warnings(session: SessionData, own: Capture, found: Snooping, T_mount: Array) -> tuple[str, ...]:
    """Return session-level warnings: background in the scans, steps between views, implausible pose errors.

    Args:
        T_mount: (4, 4) hand-eye under which `found` was made.
    """
    names = session.names
    background = (problem.fix for problem in background_problems(session, own, T_mount, found))
    warnings = (*background, *(step.describe(names, session.length_unit) for step in found.steps))
    rounded = rounding_that_explains(session, found)
    if rounded is not None:
        return (f"{rounded.describe()}.", *warnings)
    if not scatter_is_doubtful(session, found):
        few = check_few_views(session, found)
        return warnings if few is None else (few, *warnings)
    twists = frames.log(found.unconstrained.poses @ frames.inverse(own.poses(T_mount)))
    middles = np.array([points.mean(axis=0) for points in own.visible_points])
    moved = np.linalg.norm(
        twists[:, 3:] + np.cross(twists[:, :3], frames.transform(own.poses(T_mount), middles[:, None])[:, 0]), axis=1
    )
    worst = [v for v in np.argsort(-moved) if v not in found.left_out][:_LISTED]
    farthest = ", ".join(f"{names[v]} ({moved[v]:.3g} {session.length_unit})" for v in worst)
    return (
        f"No arm scatters by {_contradiction_in_words(session, found)}: several rows or scans are wrong, and hand-eye "
        f"and pose errors are not reliable; to fix: check first {farthest}.",
        *warnings,
    )


# Enough points a view to judge millimetres.
_POINTS = 8000
# A hand-eye from the scans' own motions is right within this share of the part's size, a stated one within the other.
_GATE, _STATED_GATE = 0.15, 0.35
_CLOSES = 0.5


def deep_check(session: SessionData) -> list[SessionProblem]:
    """Return what is wrong with a session; empty if nothing is found.

    Raises:
        NoResultError: the views do not overlap under any hand-eye, and no mistake explains it.
    """
    found = _check_clouds(session) if session.has_clouds else check_targets(session)
    return [*found, *target_problems(session, sightings_of(session))]


def _check_clouds(session: SessionData) -> list[SessionProblem]:
    session, capture = thin_session(session, _POINTS)
    capture = replace(capture, sightings=drop_mislabelled(capture.sightings))
    found = rank_hypotheses(session, register_scan_pairs(capture))
    named = proven_hypotheses(found)
    if named and named[0].hypothesis.kind != "exchanged":
        return [_convention_problem(session, named)]
    try:
        problems, contradicted = _check_views(session, capture, found)
    except NoResultError:
        undone = _mistake_from_surfaces(session, capture, found) or _mistake_from_motions(session, found)
        if undone is None:
            raise
        return [undone]
    # The scanner's motions may agree with poses that were read otherwise, and with those as stated hardly.
    stated = max((e.closed for e in found if e.hypothesis.kind == "stated"), default=1.0)
    rivalled = bool(found) and stated < _CLOSES * found[0].closed
    if not contradicted and not (problems and rivalled):
        return problems
    undone = (
        _convention_problem(session, named)
        if named and contradicted
        else _mistake_from_surfaces(session, capture, found)
    )
    undone = undone or _mistake_from_motions(session, found)
    return problems if undone is None else [undone]


def _check_views(
    session: SessionData, capture: Capture, found: Sequence[MotionFit]
) -> tuple[list[SessionProblem], bool]:
    """Return problems of single views under the stated poses, and True if these contradict the scans altogether."""
    T_mount, snooped = snoop_from_start(session, capture, _starting_hand_eye(session, capture, found))
    size = length_problem(snooped.model, capture.T_reference_mount, snooped.blunder_search.mean_columns)
    if size is not None:
        return [size], False
    problems = explain_misplaced(session, capture, T_mount, snooped)
    contradicted = poses_contradict_scans(session, snooped) and not any(p.kind == "disconnected" for p in problems)
    rounded = rounding_that_explains(session, snooped)
    if rounded is not None:
        problems = [SessionProblem(rounded.kind, (), rounded.describe(), certain=contradicted), *problems]
        return problems, False
    if contradicted:
        size = length_problem(
            snooped.model, capture.T_reference_mount, snooped.blunder_search.mean_columns, likely=True
        )
        problems = problems if size is None else [size, *problems]
        problems.append(SessionProblem("displaced", tuple(session.names), _unexplained_text(session, snooped)))
    for m in snooped.suspected:
        fix = (
            f"the view {displacement_in_words(session, m)}, which an effect of the arm may cause too; to fix: run and "
            "diagnose, and look at this scan"
        )
        problems.append(SessionProblem("displaced", (session.names[m.view],), fix, certain=False))
    return problems + background_problems(session, capture, T_mount, snooped), contradicted


def _starting_hand_eye(session: SessionData, capture: Capture, found: Sequence[MotionFit]) -> tuple[Array, float]:
    """Return a hand-eye that these poses allow, and the distance between partners to begin with."""
    stated = next((e for e in found if e.hypothesis.kind == "stated" and e.scale == 1.0), None)
    size = part_size([capture])
    if stated is not None and stated.closed >= _CLOSES:
        return stated.T_mount, _GATE * size
    if session.scanner.T_mount is not None:
        return session.scanner.T_mount, _STATED_GATE * size
    coarse = find_coarse_hand_eye([capture])
    return coarse.T_mount, coarse.gate


def snoop_from_start(session: SessionData, capture: Capture, start: tuple[Array, float]) -> tuple[Array, Snooping]:
    """Return the hand-eye refined from a start (hand-eye, gate), and what snooping finds under it."""
    T_mount, overlaps, _ = icp_hand_eye([capture], start[0], [start[1]])
    unconstrained = unconstrained_poses(capture, capture.poses(T_mount), overlaps[0].gate)
    usual = UsualEffects(measurement_of(session, capture), Model(T_mount))
    return T_mount, apply_displacement_limits(
        session, snoop_views(capture, T_mount, overlaps[0].gate, unconstrained, usual)
    )


def _mistake_from_surfaces(session: SessionData, capture: Capture, found: Sequence[MotionFit]) -> SessionProblem | None:
    """Return the mistake that, undone, lets the surfaces agree without contradiction; None if there is none."""
    fallen = hypotheses_by_surface(capture, found)
    if not fallen:
        return None
    best = fallen[0].hypothesis
    used = range(len(session.views)) if best.used is None else best.used
    views = tuple(replace(session.views[v], T_base_flange=best.T_base_flange[v], joints=None) for v in used)
    right = replace(session, mount=best.mount, views=views)
    try:
        _, snooped = snoop_from_start(
            right, thin_session(right, _POINTS)[1], (fallen[0].T_mount, _GATE * part_size([capture]))
        )
    except NoResultError:
        return None
    if poses_contradict_scans(right, snooped):
        return None
    return _convention_problem(session, fallen)


def _mistake_from_motions(session: SessionData, found: Sequence[MotionFit]) -> SessionProblem | None:
    """Return the mistake that the motions show short of proof; None if there is none."""
    likely = likeliest_hypotheses(found)
    return _convention_problem(session, likely) if likely else None


def _convention_problem(session: SessionData, named: Sequence[MotionFit | SurfaceFit]) -> SessionProblem:
    """Return one problem from hypotheses that are as likely, the best first."""
    best = named[0].hypothesis
    fixes = [e.hypothesis.fix for e in named]
    if best.kind == "unit" and isinstance(named[0], MotionFit):
        fixes = depth_scale_fix(session, named[0].scale) or fixes
    return SessionProblem(best.kind, names_of_views(best.rows, session.names), likeliest_text(fixes))


def depth_scale_fix(session: SessionData, scale: float) -> list[str]:
    """Return what to write beside depth images whose counts are of another length; nothing for other clouds."""
    factor, table = known_unit_ratio(scale), session.path / "views.csv"
    if factor is None or not table.is_file():
        return []
    with table.open(encoding="utf-8", newline="") as rows:
        image = session.path / str(next(csv.DictReader(rows), {}).get("cloud"))
    if image.suffix.lower() not in DEPTH_SUFFIXES:
        return []
    camera = find_intrinsics(image)
    per_metre = (camera.units_per_metre or 1000.0) * factor
    return [
        f"the clouds are {factor:.6g} times as large as the robot's motions, so a count of depth is "
        f'{1000 / per_metre:.4g} mm; to fix: write "depth_scale": {per_metre:.6g} (counts per metre) in '
        f"{camera.source.name}"
    ]


_CHECK_ROWS = "check that rows and clouds belong together and how the poses were converted"
# A hand-eye that differs by chance alone is refused once in a million.
_OWN_MODEL_CHANCE = 1e-6
# Views that show two motions, the fewest that a hand-eye follows from.
_MOTIONS = 3
# From this share of the views on, a mistake of the whole session is looked for; a part that was clamped anew, or scans
# that changed places, leave many views out and a good rest.
_MAX_EXCLUDED_SHARE = 1 / 3
_SINGLE_VIEW_KINDS = ("displaced", "disconnected", "foreign", "duplicate_scan", "duplicate_pose")
_KINDS_LEAVING_A_REST = ("reclamped", "exchanged")


def refuse(session: SessionData, problems: Sequence[SessionProblem]) -> None:
    """Raise what a deep check found; do nothing where it found nothing certain."""
    for problem in (p for p in problems if p.certain):
        kind = NoResultError if problem.kind in ("displaced", "disconnected") else InputError
        raise kind(f"{session.path}: the poses contradict what was measured: {problem.line(session.names)}")


def refuse_whole(session: SessionData) -> list[SessionProblem]:
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
def refuse_explained_mistake(session: SessionData) -> Iterator[None]:
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


def require_majority(session: SessionData, left_out: Sequence[ExcludedView]) -> None:
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
            f"the scans do not show which half is right; to fix: {_CHECK_ROWS}"
        )


def require_own_model(session: SessionData, correction: Correction, index: int) -> None:
    """Refuse a model whose hand-eye is off by more than any arm moves it, as these scans clearly show."""
    own, T_mount = correction.captures[index], correction.model.T_mount
    fitted = fit_hand_eye([own], [correction.unconstrained[index]], T_mount)
    turn, shift = _hand_eye_difference(own, T_mount, fitted.T_mount)
    if not beyond_any_arm(session, turn, shift):
        return
    # Unconstrained views that start far off have not converged, which would count as scatter: once more from there.
    unconstrained = unconstrained_poses(own, own.poses(fitted.T_mount), correction.overlaps[index].gate)
    fitted = fit_hand_eye([own], [unconstrained], fitted.T_mount)
    turn, shift = _hand_eye_difference(own, T_mount, fitted.T_mount)
    xi = frames.log(frames.inverse(T_mount) @ fitted.T_mount)
    clear = xi @ np.linalg.solve(fitted.covariance + correction.model.covariance, xi) > chi2_limit(_OWN_MODEL_CHANCE, 6)
    if clear and beyond_any_arm(session, turn, shift):
        raise NoResultError(
            f"{session.path}: the model's hand-eye is {shift:.3g} {session.length_unit} and {1e3 * turn:.3g} mrad off "
            "what these scans show: it belongs to another mount, scanner or unit; to fix: run without --hand-eye"
        )


def require_two_motions(session: SessionData) -> None:
    """Refuse two views from which no hand-eye was found: one motion leaves two directions of it open.

    Raises:
        NoResultError: there are no more.
    """
    if len(session.views) < _MOTIONS:
        raise NoResultError(
            f"{session.path}: two views show one motion, and no hand-eye brings them together; "
            "to fix: add views turned about another axis, or take the hand-eye of another run (--hand-eye RUN)"
        )


def unexplained_error(session: SessionData, found: Snooping) -> NoResultError:
    """Return the refusal of poses that contradict the scans beyond any arm, where no usual mistake explains it."""
    return NoResultError(f"{session.path}: {_unexplained_text(session, found)}")


def _unexplained_text(session: SessionData, found: Snooping) -> str:
    return (
        f"the poses contradict the scans by {_contradiction_in_words(session, found)}, more than any arm, and no usual "
        f"mistake explains it; to fix: {_CHECK_ROWS}"
    )


def _hand_eye_difference(own: Capture, T_mount: Array, other: Array) -> tuple[float, float]:
    """Return the angle (rad) between two hand-eyes, and how far they put the part from each other."""
    xi = frames.log(frames.inverse(T_mount) @ other)
    middle = np.mean([scan.points.mean(axis=0) for scan in own.scans], axis=0)
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:] + np.cross(xi[:3], middle)))
