"""`stitch check --deep`: everything that people do wrong with a session, tried out; no run is made."""

from collections.abc import Sequence
from dataclasses import replace

from stitch.errors import NoResultError
from stitch.frames import Array
from stitch.integrity.arm_limits import (
    apply_displacement_limits,
    contradiction_in_words,
    displacement_in_words,
    poses_contradict_scans,
)
from stitch.integrity.background import background_problems
from stitch.integrity.conventions import likeliest_hypotheses, proven_hypotheses, rank_hypotheses
from stitch.integrity.hypotheses import Hypothesis
from stitch.integrity.linkage import names_of_views
from stitch.integrity.motion_fit import MotionFit
from stitch.integrity.pairing import explain_misplaced
from stitch.integrity.problems import SessionProblem
from stitch.integrity.relative_scans import register_scan_pairs
from stitch.integrity.robot_lengths import length_problem
from stitch.integrity.snooping import MisplacedView, Snooping, snoop_views
from stitch.integrity.surface_verdict import hypotheses_by_surface
from stitch.integrity.target_faults import target_problems
from stitch.integrity.targets import check_targets
from stitch.integrity.usual_effects import UsualEffects
from stitch.measurement.capture import Capture, part_size
from stitch.measurement.measurement import measurement_of
from stitch.measurement.session import Session
from stitch.measurement.sightings import sightings_of
from stitch.measurement.thinning import thin_session
from stitch.model.model import Model
from stitch.observations.surfaces.free_poses import unconstrained_poses
from stitch.observations.targets.mislabelled import drop_mislabelled
from stitch.stages.coarse import find_coarse_hand_eye
from stitch.stages.correct import icp_hand_eye

# Enough points a view to judge millimetres.
_POINTS = 8000
# A hand-eye from the scans' own motions is right within this share of the part's size, a stated one within the other.
_GATE, _STATED_GATE = 0.15, 0.35
_CLOSES = 0.5


def deep_check(session: Session) -> list[SessionProblem]:
    """What is wrong with a session; empty if nothing is found.

    Raises:
        NoResultError: the views do not overlap under any hand-eye, and no mistake explains it.
    """
    found = _check_clouds(session) if session.has_clouds else check_targets(session)
    return [*found, *target_problems(session, sightings_of(session))]


def _check_clouds(session: Session) -> list[SessionProblem]:
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
    if not contradicted and not (problems and _stated_poses_rivalled(found)):
        return problems
    undone = (
        _convention_problem(session, named)
        if named and contradicted
        else _mistake_from_surfaces(session, capture, found)
    )
    undone = undone or _mistake_from_motions(session, found)
    return problems if undone is None else [undone]


def _check_views(session: Session, capture: Capture, found: Sequence[MotionFit]) -> tuple[list[SessionProblem], bool]:
    """What is wrong with single views under the poses as stated, and whether these contradict the scans altogether."""
    T_mount, snooped = snoop_from_start(session, capture, _starting_hand_eye(session, capture, found))
    size = length_problem(snooped.model, capture.T_reference_mount, snooped.blunder_search.mean_columns)
    if size is not None:
        return [size], False
    problems = explain_misplaced(session, capture, T_mount, snooped)
    contradicted = poses_contradict_scans(session, snooped) and not any(p.kind == "disconnected" for p in problems)
    if contradicted:
        problems.append(_unexplained_problem(session, snooped))
    problems += [_suspected_problem(session, m) for m in snooped.suspected]
    return problems + background_problems(session, capture, T_mount, snooped), contradicted


def _stated_poses_rivalled(found: Sequence[MotionFit]) -> bool:
    """True if the scanner's motions agree with poses that were read otherwise, and with those as stated hardly."""
    stated = max((e.closed for e in found if e.hypothesis.kind == "stated"), default=1.0)
    return bool(found) and stated < _CLOSES * found[0].closed


def _starting_hand_eye(session: Session, capture: Capture, found: Sequence[MotionFit]) -> tuple[Array, float]:
    """A hand-eye that these poses allow, and the distance between partners to begin with."""
    stated = next((e for e in found if e.hypothesis.kind == "stated" and e.scale == 1.0), None)
    size = part_size([capture])
    if stated is not None and stated.closed >= _CLOSES:
        return stated.T_mount, _GATE * size
    if session.scanner.T_mount is not None:
        return session.scanner.T_mount, _STATED_GATE * size
    begun = find_coarse_hand_eye([capture])
    return begun.T_mount, begun.gate


def snoop_from_start(session: Session, capture: Capture, start: tuple[Array, float]) -> tuple[Array, Snooping]:
    """The hand-eye closed in on from a start (hand-eye, gate), and what snooping says under it."""
    T_mount, overlaps, _ = icp_hand_eye([capture], start[0], [start[1]])
    freed = unconstrained_poses(capture, capture.poses(T_mount), overlaps[0].gate)
    usual = UsualEffects(measurement_of(session, capture), Model(T_mount))
    return T_mount, apply_displacement_limits(session, snoop_views(capture, T_mount, overlaps[0].gate, freed, usual))


def _mistake_from_surfaces(session: Session, capture: Capture, found: Sequence[MotionFit]) -> SessionProblem | None:
    """The mistake without which the surfaces fall together and nothing contradicts any more; None if there is none."""
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
    return _hypothesis_problem(session, best, [f.hypothesis.fix for f in fallen])


def _mistake_from_motions(session: Session, found: Sequence[MotionFit]) -> SessionProblem | None:
    """The mistake that the motions show short of proof; None if there is none."""
    likely = likeliest_hypotheses(found)
    return _convention_problem(session, likely) if likely else None


def _convention_problem(session: Session, named: tuple[MotionFit, ...]) -> SessionProblem:
    """One problem from hypotheses that explain the motions equally well."""
    return _hypothesis_problem(session, named[0].hypothesis, [e.hypothesis.fix for e in named])


def _hypothesis_problem(session: Session, best: Hypothesis, fixes: Sequence[str]) -> SessionProblem:
    """The problem of a hypothesis, with what is as likely."""
    fixes = list(dict.fromkeys(fixes))
    fix = fixes[0] + (f"; as likely: {'; '.join(fixes[1:3])}" if len(fixes) > 1 else "")
    return SessionProblem(best.kind, tuple(names_of_views(best.rows, session.names)), fix)


def _suspected_problem(session: Session, found: MisplacedView) -> SessionProblem:
    fix = f"{displacement_in_words(session, found)}, as effects of an arm may do too: run and diagnose, and look at this scan"
    return SessionProblem("displaced", (session.views[found.view].name,), fix, certain=False)


def _unexplained_problem(session: Session, found: Snooping) -> SessionProblem:
    off = contradiction_in_words(session, found)
    fix = (
        f"poses contradict the scans by {off}, more than any arm; no usual mistake explains it: check that rows and "
        "clouds belong together and how the poses were converted"
    )
    return SessionProblem("displaced", tuple(session.names), fix)
