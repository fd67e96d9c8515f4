"""Find what is wrong with a session without a run (`stitch check --deep`), and refuse it in a run."""

import csv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace

from stitch.errors import InputError, NoResultError
from stitch.fit.coarse import find_coarse_hand_eye
from stitch.fit.correct import icp_hand_eye, require_near_scanner
from stitch.model.model import Model
from stitch.numerics.frames import Array
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.observations.targets.outliers import drop_mislabelled
from stitch.run_data import ExcludedView
from stitch.screening.closing import SurfaceFit, hypotheses_by_surface
from stitch.screening.conventions import likeliest_hypotheses, proven_hypotheses, rank_hypotheses
from stitch.screening.hypotheses import (
    KINDS_LEAVING_A_REST,
    KINDS_OF_VIEWS,
    KINDS_WITHOUT_A_CAUSE,
    known_unit_ratio,
    problem,
    sentence,
)
from stitch.screening.motions import MotionFit, register_scan_pairs
from stitch.screening.pairing import explain_misplaced
from stitch.screening.plausibility import (
    apply_displacement_limits,
    background_problems,
    poses_contradict_scans,
    rounding_that_explains,
    scatter_in_words,
    suspicion_in_words,
)
from stitch.screening.pose_tests import length_problem
from stitch.screening.problems import SessionProblem, likeliest_text, list_views
from stitch.screening.snooping import Snooping, snoop_views
from stitch.screening.stock import find_stock, stock_problems
from stitch.screening.target_checks import check_targets, target_problems
from stitch.screening.view_model import UsualEffects
from stitch.session.capture import Capture, part_size, sightings_of
from stitch.session.measurement import measurement_of
from stitch.session.reading.depth_image import DEPTH_SUFFIXES
from stitch.session.reading.intrinsics import find_intrinsics
from stitch.session.session import SessionData
from stitch.session.thinning import thin_session

# Enough points a view to judge millimetres.
_POINTS = 8000
# A hand-eye from the scans' own motions is right within this share of the part's size, a stated one within the other.
_GATE, _STATED_GATE = 0.15, 0.35
# Share of the motions that agree with poses that are not read otherwise.
_CLOSES = 0.5
# Views that show two motions, the fewest that a hand-eye follows from.
_MOTIONS = 3
# From this share of the views on, a mistake of the whole session is looked for; a part that was clamped anew, or scans
# that changed places, leave many views out and a good rest.
_MAX_EXCLUDED_SHARE = 1 / 3


def deep_check(session: SessionData) -> list[SessionProblem]:
    """Return what is wrong with a session; empty if nothing is found.

    Raises:
        NoResultError: the views do not overlap under any hand-eye, and no mistake explains it.
    """
    of_poses = _check_clouds(session) if session.has_clouds else check_targets(session)
    return [*of_poses, *target_problems(session, sightings_of(session))]


def _check_clouds(session: SessionData) -> list[SessionProblem]:
    """Return the problems of a session of scans.

    In this order: a mistake of all poses that the scanner's motions prove is the only answer, since it makes all views
    look wrong. Else the views are tested under the poses as stated. A likely mistake of all poses is looked for where
    these contradict the scans, or where another hypothesis explains twice as many motions.
    """
    session, capture = thin_session(session, _POINTS)
    capture = replace(capture, sightings=drop_mislabelled(capture.sightings))
    ranked = rank_hypotheses(session, register_scan_pairs(capture))
    proven = proven_hypotheses(ranked)
    if proven and proven[0].hypothesis.kind != "exchanged":
        return [_convention_problem(session, proven)]
    try:
        problems, contradicted = _check_views(session, capture, ranked)
    except NoResultError:
        undone = _likely_mistake(session, capture, ranked)
        if undone is None:
            raise
        return [undone]
    # Another hypothesis may explain at least twice as many motions as the poses as stated.
    stated = max((fit.closed for fit in ranked if fit.hypothesis.kind == "stated"), default=1.0)
    rivalled = bool(ranked) and stated < _CLOSES * ranked[0].closed
    if not contradicted and not (problems and rivalled):
        return problems
    if proven and contradicted:
        return [_convention_problem(session, proven)]
    undone = _likely_mistake(session, capture, ranked)
    return problems if undone is None else [undone]


def _check_views(
    session: SessionData, capture: Capture, ranked: Sequence[MotionFit]
) -> tuple[list[SessionProblem], bool]:
    """Return the problems of views under the stated poses, and whether these poses contradict the scans altogether.

    Scans are cleared of stock first, one view after the other. A factor on the robot's lengths is the only answer; so
    is, with the views' problems, a table that rounds its numbers.

    Args:
        ranked: hypotheses about the poses, for a hand-eye to begin with.
    """
    snooping = _snoop_from_start(session, capture, *_starting_hand_eye(session, capture, ranked))
    while stock := find_stock(session, snooping):
        capture = capture.without_stock(stock)
        snooping = _snoop_from_start(session, capture, snooping.T_mount, snooping.unconstrained.overlaps.gate)
    columns = snooping.blunder_search.mean_columns
    lengths = length_problem(snooping.model, capture.T_reference_mount, columns)
    if lengths is not None:
        return [lengths], False
    problems = explain_misplaced(session, snooping)
    contradicted = poses_contradict_scans(session, snooping) and not any(p.kind == "disconnected" for p in problems)
    rounding = rounding_that_explains(session, snooping)
    if rounding is not None:
        return [SessionProblem(rounding.kind, (), rounding.describe(), certain=contradicted), *problems], False
    if contradicted:
        lengths = length_problem(snooping.model, capture.T_reference_mount, columns, likely=True)
        problems = problems if lengths is None else [lengths, *problems]
        problems.append(problem("unexplained", session.names, by=scatter_in_words(session, snooping)))
    for m in snooping.suspected:
        off = suspicion_in_words(session, m)
        problems.append(problem("suspected", [session.names[m.view]], certain=False, off=off))
    problems += stock_problems(session, capture)
    return problems + background_problems(session, snooping), contradicted


def _starting_hand_eye(session: SessionData, capture: Capture, ranked: Sequence[MotionFit]) -> tuple[Array, float]:
    """Return a hand-eye (4, 4) to begin with, and the largest distance between corresponding points, length_unit.

    From the scans' motions if these agree with the poses, else stated in session.toml, else searched.
    """
    stated = next((fit for fit in ranked if fit.hypothesis.kind == "stated" and fit.scale == 1.0), None)
    size = part_size([capture])
    if stated is not None and stated.closed >= _CLOSES:
        return stated.T_mount, _GATE * size
    if session.scanner.T_mount is not None:
        return session.scanner.T_mount, _STATED_GATE * size
    coarse = find_coarse_hand_eye([capture])
    return coarse.T_mount, coarse.gate


def _snoop_from_start(session: SessionData, capture: Capture, T_mount: Array, gate: float) -> Snooping:
    """Return what the tests of the views find under a hand-eye refined by ICP.

    Args:
        T_mount: (4, 4) hand-eye to begin with.
        gate: largest distance between corresponding points at first, length_unit.
    """
    T_mount, overlaps, _ = icp_hand_eye([capture], T_mount, [gate])
    require_near_scanner([capture], T_mount)
    unconstrained = unconstrained_poses(capture, capture.poses(T_mount), overlaps[0].gate)
    usual = UsualEffects(measurement_of(session, capture), Model(T_mount))
    return apply_displacement_limits(session, snoop_views(capture, T_mount, unconstrained, usual))


def _likely_mistake(session: SessionData, capture: Capture, ranked: Sequence[MotionFit]) -> SessionProblem | None:
    """Return a likely mistake of all poses as a problem; None if there is none.

    First choice: one that, undone, lets the surfaces of all views agree. Second: one that the motions suggest, short of
    proof (`likeliest_hypotheses`).
    """
    by_surface = hypotheses_by_surface(capture, ranked)
    if by_surface and _surfaces_agree(session, capture, by_surface[0]):
        return _convention_problem(session, by_surface)
    likely = likeliest_hypotheses(ranked)
    return _convention_problem(session, likely) if likely else None


def _surfaces_agree(session: SessionData, capture: Capture, fit: SurfaceFit) -> bool:
    """Return whether the poses of a hypothesis, tested as a session of their own, do not contradict the scans."""
    h = fit.hypothesis
    used = range(len(session.views)) if h.used is None else h.used
    views = tuple(replace(session.views[v], T_base_flange=h.T_base_flange[v], joints=None) for v in used)
    right = replace(session, mount=h.mount, views=views)
    gate = _GATE * part_size([capture])
    try:
        snooping = _snoop_from_start(right, thin_session(right, _POINTS)[1], fit.T_mount, gate)
    except NoResultError:
        return False
    return not poses_contradict_scans(right, snooping)


def _convention_problem(session: SessionData, fits: Sequence[MotionFit | SurfaceFit]) -> SessionProblem:
    """Return one problem of a session from hypotheses that are about equally likely, the best first: it names all."""
    best = fits[0].hypothesis
    fixes = [fit.hypothesis.fix for fit in fits]
    if best.kind == "unit" and isinstance(fits[0], MotionFit):
        fixes = _depth_scale_fix(session, fits[0].scale) or fixes
    return SessionProblem(best.kind, tuple(session.names[v] for v in best.rows), likeliest_text(fixes))


def _depth_scale_fix(session: SessionData, scale: float) -> list[str]:
    """Return the fix of a wrong unit where the clouds are depth images: the depth_scale to write; [] for other clouds.

    Args:
        scale: fitted factor on the robot's lengths against the scans'.
    """
    factor = known_unit_ratio(scale)
    table = session.path / "views.csv"
    if factor is None or not table.is_file():
        return []
    with table.open(encoding="utf-8", newline="") as rows:
        image = session.path / str(next(csv.DictReader(rows), {}).get("cloud"))
    if image.suffix.lower() not in DEPTH_SUFFIXES:
        return []
    camera = find_intrinsics(image)
    per_metre = (camera.units_per_metre or 1000.0) * factor
    count = 1000 / per_metre
    return [sentence("depth", factor=factor, count=count, per_metre=per_metre, file=camera.source.name)]


def refuse(session: SessionData, problems: Sequence[SessionProblem]) -> None:
    """Raise the first problem of a deep check that is certain; do nothing where none is.

    Raises:
        NoResultError: it is of a kind that says that something is wrong, not what (`KINDS_WITHOUT_A_CAUSE`).
        InputError: it is of any other kind.
    """
    for certain in (p for p in problems if p.certain):
        error = NoResultError if certain.kind in KINDS_WITHOUT_A_CAUSE else InputError
        raise error(f"{session.path}: the poses contradict what was measured: {certain.line(session.names)}")


def refuse_whole(session: SessionData) -> list[SessionProblem]:
    """Return what a deep check finds, unless it finds a mistake of the whole session, as a wrong order of angles.

    Raises:
        InputError: there is one.
    """
    problems = deep_check(session)
    refuse(session, [p for p in problems if p.kind not in (*KINDS_OF_VIEWS, *KINDS_LEAVING_A_REST)])
    return problems


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


def refuse_contradiction(session: SessionData, snooping: Snooping, *, given: bool) -> None:
    """Refuse poses that contradict the scans beyond any arm.

    Args:
        given: the hand-eye is that of another run.

    Raises:
        InputError: a usual mistake explains it.
        NoResultError: none does; or there are two views, of which one motion leaves two directions of a hand-eye open.
    """
    if not given and len(session.views) < _MOTIONS:
        raise NoResultError(
            f"{session.path}: two views show one motion, and no hand-eye brings them together; "
            "to fix: add views turned about another axis, or take the hand-eye of another run (--hand-eye RUN)"
        )
    refuse(session, deep_check(session))
    raise NoResultError(f"{session.path}: {sentence('unexplained', by=scatter_in_words(session, snooping))}")


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
    problems = refuse_whole(session)
    if 2 * len(left_out) >= len(session.views) and not any(p.kind in KINDS_LEAVING_A_REST for p in problems):
        gone = {item.view for item in left_out}
        names = list_views([name for name in session.names if name in gone], session.names)
        raise NoResultError(
            f"{session.path}: {len(left_out)} of {len(session.views)} views ({names}) do not belong to the others, and "
            "the scans do not show which half is right; to fix: check that rows and clouds belong together and how the "
            "poses were converted"
        )
