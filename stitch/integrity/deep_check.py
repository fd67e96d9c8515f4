"""`stitch check --deep`: everything that people do wrong with a session, tried out; no run is made."""

from functools import partial

from stitch.frames import Array
from stitch.integrity.conventions import explained, verdict
from stitch.integrity.linkage import only
from stitch.integrity.motion_fit import Explained
from stitch.integrity.pairing import explain
from stitch.integrity.problems import Problem
from stitch.integrity.relative_scans import relative_scans
from stitch.integrity.robot_lengths import length_problem
from stitch.integrity.snooping import Misplaced, Snooping, snoop
from stitch.integrity.targets import check_targets
from stitch.integrity.usual_effects import usual_twists
from stitch.measurement.capture import Capture, part_size
from stitch.measurement.measurement import measurement_of
from stitch.measurement.session import Session
from stitch.model.model import Model
from stitch.observations.surfaces.free_poses import free_poses
from stitch.observations.surfaces.thinning import thinned
from stitch.stages.coarse import coarse
from stitch.stages.correct import close_in
from stitch.units import METRES

# Enough points a view to judge millimetres.
_POINTS = 8000
# No arm scatters by more.
_ROTATION, _TRANSLATION_M = 0.010, 0.005
# No effect of an arm is believed to displace a single view by more than half of that.
_VIEW_ROTATION, _VIEW_M = 0.005, 0.0025
# A hand-eye from the scans' own motions is right within this share of the part's size, a stated one within the other.
_GATE, _STATED_GATE = 0.15, 0.35
_CLOSES = 0.5


def deep_check(session: Session) -> list[Problem]:
    """What is wrong with a session; empty if nothing is found.

    Raises:
        NoResultError: the views do not overlap under any hand-eye, and no mistake explains it.
    """
    if not session.has_clouds:
        return check_targets(session)
    session, capture = thinned(session, _POINTS)
    found = explained(session, relative_scans(capture))
    named = verdict(found)
    if named and named[0].hypothesis.kind != "exchanged":
        return [_convention(session, named)]
    T_mount, snooped = examined(session, capture, found)
    size = length_problem(snooped.model, capture.T_reference_mount)
    if size is not None:
        return [size]
    problems = explain(session, capture, T_mount, snooped)
    if contradicts(session, snooped) and not any(p.kind == "disconnected" for p in problems):
        if named:
            return [_convention(session, named)]
        problems.append(_unexplained(session, snooped))
    return problems + [_suspected(session, m) for m in snooped.suspected]


def examined(session: Session, capture: Capture, found: list[Explained]) -> tuple[Array, Snooping]:
    """The hand-eye that these poses allow, and what snooping says under it."""
    stated = next((e for e in found if e.hypothesis.kind == "stated" and e.scale == 1.0), None)
    size = part_size([capture])
    if stated is not None and stated.closed >= _CLOSES:
        start, gate = stated.T_mount, _GATE * size
    elif session.scanner.T_mount is not None:
        start, gate = session.scanner.T_mount, _STATED_GATE * size
    else:
        begun = coarse([capture])
        start, gate = begun.T_mount, begun.gate
    T_mount, overlaps, _ = close_in([capture], start, [gate])
    freed = free_poses(capture, capture.poses(T_mount), overlaps[0].gate)
    usual = partial(usual_twists, measurement_of(session, capture), Model(T_mount))
    return T_mount, judged_by_size(session, snoop(capture, T_mount, overlaps[0].gate, freed, usual))


def judged_by_size(session: Session, found: Snooping) -> Snooping:
    """Suspected views that are off by more than what effects of an arm are believed to do are misplaced."""

    def too_far(m: Misplaced) -> bool:
        return m.rotation > _VIEW_ROTATION or m.distance * METRES[session.length_unit] > _VIEW_M

    return found.settled(too_far)


def contradicts(session: Session, found: Snooping) -> bool:
    """True if the poses contradict the scans beyond what any arm does."""
    lost = len(found.left_out) > len(session.views) / 2
    return lost or beyond_any_arm(session, found.rotation, found.translation)


def beyond_any_arm(session: Session, rotation: float, translation: float) -> bool:
    """True if a rotation (rad) or a translation (length_unit) is larger than what any arm does."""
    return rotation > _ROTATION or translation > _TRANSLATION_M / METRES[session.length_unit]


def _convention(session: Session, named: tuple[Explained, ...]) -> Problem:
    """One problem from hypotheses that explain the motions equally well."""
    best = named[0].hypothesis
    fixes = list(dict.fromkeys(e.hypothesis.fix for e in named))
    fix = fixes[0] + (f"; as likely: {'; '.join(fixes[1:3])}" if len(fixes) > 1 else "")
    names = [view.name for view in session.views]
    return Problem(best.kind, tuple(only(best.rows, names)), fix)


def stands_off(session: Session, found: Misplaced) -> str:
    """How far a suspected view stands off, in words."""
    return f"stands off by {found.distance:.3g} {session.length_unit} and {1e3 * found.rotation:.3g} mrad"


def contradicted_by(session: Session, found: Snooping) -> str:
    """By how much the poses contradict the scans, in words."""
    return f"{1e3 * found.rotation:.3g} mrad and {found.translation:.3g} {session.length_unit}"


def _suspected(session: Session, found: Misplaced) -> Problem:
    fix = f"{stands_off(session, found)}, as effects of an arm may do too: run and diagnose, and look at this scan"
    return Problem("displaced", (session.views[found.view].name,), fix, certain=False)


def _unexplained(session: Session, found: Snooping) -> Problem:
    off = contradicted_by(session, found)
    fix = (
        f"poses contradict the scans by {off}, more than any arm; no usual mistake explains it: check that rows and "
        "clouds belong together and how the poses were converted"
    )
    return Problem("displaced", tuple(view.name for view in session.views), fix)
