"""Which views of a run may be fused: blunders named and left out, contradictions beyond any arm refused."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from stitch import frames
from stitch.errors import InputError, NoResultError
from stitch.frames import Array
from stitch.integrity.arm_limits import (
    beyond_any_arm,
    contradicted_by,
    contradicts,
    judged_by_size,
    stands_off,
)
from stitch.integrity.deep_check import deep_check
from stitch.integrity.pairing import explain
from stitch.integrity.problems import Problem
from stitch.integrity.robot_lengths import length_problem
from stitch.integrity.snooping import Misplaced, Snooping, snoop
from stitch.integrity.targets import check_targets
from stitch.integrity.usual_effects import usual_twists
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
from stitch.observations.surfaces.free_poses import free_poses
from stitch.observations.surfaces.hand_eye import fit_hand_eye
from stitch.observations.targets.target_fit import TargetFit
from stitch.runs.run import LeftOut, ViewLinks
from stitch.stages.correction import Correction
from stitch.statistics.tails import chi2_limit

# A hand-eye that differs by chance alone is refused once in a million.
_CHANCE = 1e-6


@dataclass(frozen=True)
class Admission:
    """What may be fused of one session."""

    left_out: tuple[LeftOut, ...] = ()
    suspected: tuple[LeftOut, ...] = ()  # off by no more than an effect of an arm may cause: fused, and noted
    links: ViewLinks = field(default_factory=ViewLinks)

    @property
    def names(self) -> set[str]:
        """Of the views that are left out."""
        return {item.view for item in self.left_out}

    def line(self) -> str:
        """What was left out and why."""
        return "; ".join(f"{item.view}: {item.why}" for item in self.left_out)

    def indices(self, session: Session) -> list[int]:
        """Numbers of the views that are left out."""
        return [v for v, view in enumerate(session.views) if view.name in self.names]


def admission(session: Session, measurement: Measurement, correction: Correction, index: int) -> Admission:
    """Examine the views of one session of a rig under a corrected model.

    Args:
        index: of the session in the rig.

    Raises:
        InputError: the poses contradict the scans beyond any arm, and a usual mistake explains it.
        NoResultError: they do, and none does; or groups of views share no surface.
    """
    own, T_mount = correction.captures[index], correction.model.T_mount
    if correction.given:
        _require_own_model(session, correction, index)
    usual = partial(usual_twists, measurement, correction.model)
    found = snoop(own, T_mount, correction.overlaps[index].gate, correction.freed[index], usual)
    found = judged_by_size(session, found)
    if contradicts(session, found):
        refuse(session, deep_check(session))
        raise _unexplained(session, found)
    size = length_problem(found.model, own.T_reference_mount, found.found.further)
    if size is not None:
        refuse(session, [size])
    if found.block is not None and not _beyond_any_slip(session, found):
        # A slip of the part, or a knock of the mount, within what a model can hold: the diagnosis names it.
        found = replace(found, block=None)
    problems = explain(session, own, T_mount, found) if found.left_out else []
    apart = next((p for p in problems if p.kind == "disconnected"), None)
    if apart is not None:
        raise NoResultError(f"{session.path}: {apart.line()}")
    out = _not_belonging(session, own, found, T_mount, problems)
    return Admission(
        left_out=out,
        suspected=tuple(_suspect(session, own, m, T_mount) for m in found.suspected),
        links=_links(session, found),
    )


def admission_of_targets(session: Session, found: TargetFit) -> Admission:
    """Labelled points: outliers are taken out one by one; poses that contradict them all are refused.

    Raises:
        InputError: a usual mistake explains it.
        NoResultError: none does.
    """
    rotation, translation = np.sqrt(found.variances[:2])
    if beyond_any_arm(session, rotation, translation):
        refuse(session, check_targets(session))
    return Admission()


def _suspect(session: Session, own: Capture, found: Misplaced, T_mount: Array) -> LeftOut:
    name, scan = session.views[found.view].name, own.scans[found.view]
    return LeftOut(name, stands_off(session, found), own.poses(T_mount)[found.view], len(scan.points))


def _beyond_any_slip(session: Session, found: Snooping) -> bool:
    """True if a block of views is displaced by more than an effect of the model may be."""
    assert found.block is not None
    lever = found.freed.overlaps.gram.lever if found.block.what == "part" else 1.0
    turn, shift = (float(np.linalg.norm(x)) for x in (found.block.estimate[:3] / lever, found.block.estimate[3:]))
    return beyond_any_arm(session, turn, shift)


def _require_own_model(session: Session, correction: Correction, index: int) -> None:
    """Refuse a model whose hand-eye is off by more than any arm moves it, as these scans clearly show."""
    own, T_mount = correction.captures[index], correction.model.T_mount
    fitted = fit_hand_eye([own], [correction.freed[index]], T_mount)
    turn, shift = _apart(own, T_mount, fitted.T_mount)
    if not beyond_any_arm(session, turn, shift):
        return
    # Views freed from far off are only on their way, and what they lack would count as scatter: once more from there.
    freed = free_poses(own, own.poses(fitted.T_mount), correction.overlaps[index].gate)
    fitted = fit_hand_eye([own], [freed], fitted.T_mount)
    turn, shift = _apart(own, T_mount, fitted.T_mount)
    xi = frames.log(frames.inverse(T_mount) @ fitted.T_mount)
    clear = xi @ np.linalg.solve(fitted.covariance + correction.model.covariance, xi) > chi2_limit(_CHANCE, 6)
    if clear and beyond_any_arm(session, turn, shift):
        raise NoResultError(
            f"{session.path}: the model's hand-eye is {shift:.3g} {session.length_unit} and {1e3 * turn:.3g} mrad off "
            "what these scans say: it belongs to another mount, scanner or unit; to fix: run without --hand-eye"
        )


def _apart(own: Capture, T_mount: Array, other: Array) -> tuple[float, float]:
    """Angle (rad) between two hand-eyes, and how far they put the part from each other."""
    xi = frames.log(frames.inverse(T_mount) @ other)
    middle = np.mean([scan.points.mean(axis=0) for scan in own.scans], axis=0)
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:] + np.cross(xi[:3], middle)))


def _unexplained(session: Session, found: Snooping) -> NoResultError:
    off = contradicted_by(session, found)
    return NoResultError(
        f"{session.path}: the poses contradict the scans by {off}, more than any arm, and no usual mistake explains "
        "it; to fix: check that rows and clouds belong together and how the poses were converted"
    )


def refuse(session: Session, problems: Sequence[Problem]) -> None:
    """Raise what a deep check found; nothing where it found nothing certain."""
    for problem in (p for p in problems if p.certain):
        kind = NoResultError if problem.kind in ("displaced", "disconnected") else InputError
        raise kind(f"{session.path}: the poses contradict what was measured: {problem.line()}")


def _not_belonging(
    session: Session, own: Capture, found: Snooping, T_mount: Array, problems: Sequence[Problem]
) -> tuple[LeftOut, ...]:
    poses = own.poses(T_mount)
    out = []
    for v in found.left_out:
        name = session.views[v].name
        why = next((p.line() for p in problems if name in p.views), "it shares no surface with the others")
        out.append(LeftOut(name, why, poses[v], len(own.scans[v].points)))
    return tuple(out)


def _links(session: Session, found: Snooping) -> ViewLinks:
    names = [view.name for view in session.views]
    return ViewLinks(
        components=tuple(tuple(names[v] for v in part) for part in found.linkage.components),
        weak=tuple((names[v], names[w]) for v, w in found.linkage.single),
    )
