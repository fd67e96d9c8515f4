"""`stitch check --deep`: everything that people do wrong with a session, tried out; no run is made."""

from collections.abc import Sequence
from dataclasses import replace

from stitch.errors import NoResultError
from stitch.frames import Array
from stitch.integrity.arm_limits import contradicted_by, contradicts, judged_by_size, stands_off
from stitch.integrity.background import background
from stitch.integrity.conventions import explained, likeliest, verdict
from stitch.integrity.hypotheses import Hypothesis
from stitch.integrity.linkage import only
from stitch.integrity.motion_fit import Explained
from stitch.integrity.pairing import explain
from stitch.integrity.problems import Problem
from stitch.integrity.relative_scans import relative_scans
from stitch.integrity.robot_lengths import length_problem
from stitch.integrity.snooping import Misplaced, Snooping, snoop
from stitch.integrity.surface_verdict import surface_verdict
from stitch.integrity.target_faults import target_faults
from stitch.integrity.targets import check_targets
from stitch.integrity.usual_effects import UsualEffects
from stitch.measurement.capture import Capture, part_size
from stitch.measurement.measurement import measurement_of
from stitch.measurement.session import Session
from stitch.measurement.sightings import sightings_of
from stitch.measurement.thinning import thinned
from stitch.model.model import Model
from stitch.observations.surfaces.free_poses import free_poses
from stitch.observations.targets.mislabelled import named_right
from stitch.stages.coarse import coarse
from stitch.stages.correct import close_in

# Enough points a view to judge millimetres.
_POINTS = 8000
# A hand-eye from the scans' own motions is right within this share of the part's size, a stated one within the other.
_GATE, _STATED_GATE = 0.15, 0.35
_CLOSES = 0.5


def deep_check(session: Session) -> list[Problem]:
    """What is wrong with a session; empty if nothing is found.

    Raises:
        NoResultError: the views do not overlap under any hand-eye, and no mistake explains it.
    """
    found = _of_clouds(session) if session.has_clouds else check_targets(session)
    return [*found, *target_faults(session, sightings_of(session))]


def _of_clouds(session: Session) -> list[Problem]:
    session, capture = thinned(session, _POINTS)
    capture = replace(capture, sightings=named_right(capture.sightings))
    found = explained(session, relative_scans(capture))
    named = verdict(found)
    if named and named[0].hypothesis.kind != "exchanged":
        return [_convention(session, named)]
    try:
        problems, contradicted = _of_views(session, capture, found)
    except NoResultError:
        undone = _undone(session, capture, found) or _likeliest(session, found)
        if undone is None:
            raise
        return [undone]
    if not contradicted and not (problems and _rivalled(found)):
        return problems
    undone = _convention(session, named) if named and contradicted else _undone(session, capture, found)
    undone = undone or _likeliest(session, found)
    return problems if undone is None else [undone]


def _of_views(session: Session, capture: Capture, found: Sequence[Explained]) -> tuple[list[Problem], bool]:
    """What is wrong with single views under the poses as stated, and whether these contradict the scans altogether."""
    T_mount, snooped = examined(session, capture, _start(session, capture, found))
    size = length_problem(snooped.model, capture.T_reference_mount, snooped.found.further)
    if size is not None:
        return [size], False
    problems = explain(session, capture, T_mount, snooped)
    contradicted = contradicts(session, snooped) and not any(p.kind == "disconnected" for p in problems)
    if contradicted:
        problems.append(_unexplained(session, snooped))
    problems += [_suspected(session, m) for m in snooped.suspected]
    return problems + background(session, capture, T_mount, snooped), contradicted


def _rivalled(found: Sequence[Explained]) -> bool:
    """True if the scanner's motions agree with poses that were read otherwise, and with those as stated hardly."""
    stated = max((e.closed for e in found if e.hypothesis.kind == "stated"), default=1.0)
    return bool(found) and stated < _CLOSES * found[0].closed


def _start(session: Session, capture: Capture, found: Sequence[Explained]) -> tuple[Array, float]:
    """A hand-eye that these poses allow, and the distance between partners to begin with."""
    stated = next((e for e in found if e.hypothesis.kind == "stated" and e.scale == 1.0), None)
    size = part_size([capture])
    if stated is not None and stated.closed >= _CLOSES:
        return stated.T_mount, _GATE * size
    if session.scanner.T_mount is not None:
        return session.scanner.T_mount, _STATED_GATE * size
    begun = coarse([capture])
    return begun.T_mount, begun.gate


def examined(session: Session, capture: Capture, start: tuple[Array, float]) -> tuple[Array, Snooping]:
    """The hand-eye closed in on from a start (hand-eye, gate), and what snooping says under it."""
    T_mount, overlaps, _ = close_in([capture], start[0], [start[1]])
    freed = free_poses(capture, capture.poses(T_mount), overlaps[0].gate)
    usual = UsualEffects(measurement_of(session, capture), Model(T_mount))
    return T_mount, judged_by_size(session, snoop(capture, T_mount, overlaps[0].gate, freed, usual))


def _undone(session: Session, capture: Capture, found: Sequence[Explained]) -> Problem | None:
    """The mistake without which the surfaces fall together and nothing contradicts any more; None if there is none."""
    fallen = surface_verdict(capture, found)
    if not fallen:
        return None
    best = fallen[0].hypothesis
    used = range(len(session.views)) if best.used is None else best.used
    views = tuple(replace(session.views[v], T_base_flange=best.T_base_flange[v], joints=None) for v in used)
    right = replace(session, mount=best.mount, views=views)
    try:
        _, snooped = examined(right, thinned(right, _POINTS)[1], (fallen[0].T_mount, _GATE * part_size([capture])))
    except NoResultError:
        return None
    if contradicts(right, snooped):
        return None
    return _named(session, best, [f.hypothesis.fix for f in fallen])


def _likeliest(session: Session, found: Sequence[Explained]) -> Problem | None:
    """The mistake that the motions show short of proof; None if there is none."""
    likely = likeliest(found)
    return _convention(session, likely) if likely else None


def _convention(session: Session, named: tuple[Explained, ...]) -> Problem:
    """One problem from hypotheses that explain the motions equally well."""
    return _named(session, named[0].hypothesis, [e.hypothesis.fix for e in named])


def _named(session: Session, best: Hypothesis, fixes: Sequence[str]) -> Problem:
    """The problem of a hypothesis, with what is as likely."""
    fixes = list(dict.fromkeys(fixes))
    fix = fixes[0] + (f"; as likely: {'; '.join(fixes[1:3])}" if len(fixes) > 1 else "")
    return Problem(best.kind, tuple(only(best.rows, session.names)), fix)


def _suspected(session: Session, found: Misplaced) -> Problem:
    fix = f"{stands_off(session, found)}, as effects of an arm may do too: run and diagnose, and look at this scan"
    return Problem("displaced", (session.views[found.view].name,), fix, certain=False)


def _unexplained(session: Session, found: Snooping) -> Problem:
    off = contradicted_by(session, found)
    fix = (
        f"poses contradict the scans by {off}, more than any arm; no usual mistake explains it: check that rows and "
        "clouds belong together and how the poses were converted"
    )
    return Problem("displaced", tuple(session.names), fix)
