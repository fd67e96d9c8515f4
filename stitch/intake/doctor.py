"""What a table does not tell is told by the scans: order of rotations, direction, unit and pairing, tried on all ways.

Three judges, from cheap to dear: the centroids of the clouds come to one point, the motions between neighbouring
scans close, the surfaces of all views fall together. The engine is that of `stitch check --deep`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.intake.alike import distinct_hypotheses, equivalent_interpretations, transferred_hand_eye
from stitch.intake.cloud_pairs import Pairing
from stitch.intake.plausible_units import POSE_UNITS
from stitch.intake.readings import Reading
from stitch.intake.ways import MM, Interpretation, all_interpretations
from stitch.integrity.centroids_meet import fit_centroids
from stitch.integrity.conventions import equivalent_hypotheses, fit_hypotheses
from stitch.integrity.motion_fit import FEWEST, MotionFit
from stitch.integrity.relative_scans import RelativeScans
from stitch.integrity.surfaces_meet import CLEARLY_BETTER, SurfaceFit, surface_misfit
from stitch.measurement.capture import Capture
from stitch.system.steps import steps

# Ways that the dear judge sees: the best of each cheap one.
_SHORT = 4
# Motions that closed give a start for the surfaces.
_CLOSED = 0.5
# A fitted scale belongs to a unit within this factor: 10 and 25.4 lie 2.5 apart.
_UNIT_FACTOR = 1.5
# Scanner or part sits at the flange if it lies this much nearer to its frame's origin than the other.
_NEARER = 1.5


@dataclass(frozen=True)
class ConventionScore:
    """A way with what the scans say of it."""

    interpretation: Interpretation
    T_mount: Array  # (4, 4) mm
    misfit: float  # mm, rms distance between the views, truncated
    meets: bool  # some views overlap
    closed: float | None  # share of the scanner's motions that close; None where not asked


@dataclass(frozen=True)
class ConventionChoice:
    """The best way and the next; `told`: the scans tell them apart."""

    best: ConventionScore
    runner_up: ConventionScore | None
    determined: bool
    equivalent: tuple[Interpretation, ...]  # others that stitch alike: they differ from the best by one fixed frame
    scanner_away: float  # mm: of the scanner from the origin of its mount's frame
    part_away: float  # mm: of the part from the origin of the reference frame

    @property
    def scanner_at_flange(self) -> bool:
        """True if the scanner rather than the part sits at the flange."""
        return self.scanner_away <= self.part_away

    @property
    def mount_determined(self) -> bool:
        """True if one of the two clearly sits nearer than the other."""
        low, high = sorted((self.scanner_away, self.part_away))
        return high > _NEARER * low


def choose_convention(
    capture: Capture,
    motions: Callable[[], RelativeScans],
    readings: Sequence[Reading],
    pairs: Sequence[Pairing],
    units: Sequence[str],
    carries: bool | None = None,
    target_motions: RelativeScans | None = None,
) -> ConventionChoice:
    """Try all ways; the motions, and pairings beside the first, only where the surfaces alone do not tell.

    Args:
        capture: the scans, mm; its poses do not count.
        motions: gives those between neighbouring scans, mm; dear.
        units: that positions can have of which the file does not say it.
        carries: whether the poses carry the mount's frame (see `Way`); None tries both.
        target_motions: motions between views that targets show, mm: where there are enough, they alone decide.
    """
    directions = (True, False) if carries is None else (carries,)
    if target_motions is not None and len(target_motions.pairs) >= FEWEST:
        paired = _with_confirmed_unit(target_motions, all_interpretations(readings, pairs, units, directions))
        return _choose_interpretation(capture, paired, target_motions, by_targets=True)
    ways = all_interpretations(readings, pairs[:1], units, directions)
    if len({way.length_unit for way in ways}) > 1:
        ways = _with_confirmed_unit(motions(), ways)
    first = _choose_interpretation(capture, ways, None)
    if not first.determined:
        first = _choose_interpretation(capture, ways, motions())
    if first.determined or len(pairs) == 1:
        return first
    every = _choose_interpretation(
        capture, _with_confirmed_unit(motions(), all_interpretations(readings, pairs, units, directions)), motions()
    )
    # What is a guess anyway leaves out no view for it.
    whole = len(every.best.interpretation.pairing.used) >= len(first.best.interpretation.pairing.used)
    return every if every.determined or (whole and every.best.misfit < first.best.misfit) else first


def _choose_interpretation(
    capture: Capture, interpretations: Sequence[Interpretation], motions: RelativeScans | None, by_targets: bool = False
) -> ConventionChoice:
    tried = [way.hypothesis(i) for i, way in enumerate(interpretations)]
    meets = fit_centroids(tried, np.array([scan.points.mean(axis=0) for scan in capture.scans]))
    closing = {} if motions is None else {int(e.hypothesis.kind): e for e in fit_hypotheses(tried, motions, "mm")}
    by_motion = sorted(closing, key=lambda i: closing[i].open)
    by_centroid = sorted(range(len(interpretations)), key=lambda i: meets[i][0])
    by_motion = distinct_hypotheses(by_motion, tried, _SHORT)
    short = (
        by_motion if by_targets else list(dict.fromkeys([*distinct_hypotheses(by_centroid, tried, _SHORT), *by_motion]))
    )
    judged = []
    for i in steps("ways to read the poses", short):
        closed = closing.get(i)
        starts = [meets[i][1], *([closed.T_mount] if closed is not None and closed.closed >= _CLOSED else [])]
        judged.append(_convention_score(interpretations[i], surface_misfit(capture, tried[i], starts), closed))
    if not by_targets:
        judged.sort(key=lambda j: j.misfit)
    best, runner_up = judged[0], judged[1] if len(judged) > 1 else None
    alone = _sole_contender(list(closing.values()))
    clear = runner_up is None or runner_up.misfit >= CLEARLY_BETTER * best.misfit
    single = alone is not None and interpretations[alone] is best.interpretation
    told = single if by_targets else (clear or single) and best.meets and len(best.interpretation.pairing.used) > 2
    same = equivalent_interpretations(best.interpretation, interpretations)
    best = replace(
        best, interpretation=same[0], T_mount=transferred_hand_eye(best.interpretation, same[0], best.T_mount)
    )
    return ConventionChoice(best, runner_up, bool(told), same[1:], *_flange_distances(capture, best))


def _convention_score(interpretation: Interpretation, fallen: SurfaceFit, closing: MotionFit | None) -> ConventionScore:
    return ConventionScore(
        interpretation, fallen.T_mount, fallen.misfit, fallen.meets, None if closing is None else closing.closed
    )


def _sole_contender(explained: Sequence[MotionFit]) -> int | None:
    """The way that the motions alone single out, if they do."""
    close = equivalent_hypotheses(explained)
    return int(close[0].hypothesis.kind) if len(close) == 1 else None


def _with_confirmed_unit(motions: RelativeScans, interpretations: Sequence[Interpretation]) -> list[Interpretation]:
    """The ways whose unit of length the motions of the scanner confirm; all where they say nothing."""
    units = {way.length_unit for way in interpretations}
    if len(units) == 1:
        return list(interpretations)
    first = {
        (way.reading.words, way.reading.layout.words, way.pairing, way.carries): way for way in interpretations[::-1]
    }
    plain = [replace(way, length_unit="mm") for way in first.values()]
    fitted = fit_hypotheses([w.hypothesis(i) for i, w in enumerate(plain)], motions, "mm", scaled=True)
    best = equivalent_hypotheses([e for e in fitted if e.scale > 0])
    if not best:
        return list(interpretations)
    unit = min(units, key=lambda u: abs(np.log(best[0].scale * MM / POSE_UNITS[u])))
    near = abs(np.log(best[0].scale * MM / POSE_UNITS[unit])) < np.log(_UNIT_FACTOR)
    return [way for way in interpretations if way.length_unit == unit] if near else list(interpretations)


def _flange_distances(capture: Capture, score: ConventionScore) -> tuple[float, float]:
    """How far the scanner lies from its mount's origin, and the part from that of the reference frame."""
    hypothesis = score.interpretation.hypothesis(0)
    poses = hypothesis.T_reference_mount @ score.T_mount
    used = range(len(poses)) if hypothesis.used is None else hypothesis.used
    centres = [frames.transform(poses[v], capture.scans[v].points.mean(axis=0)[None])[0] for v in used]
    return float(np.linalg.norm(score.T_mount[:3, 3])), float(np.linalg.norm(np.mean(centres, axis=0)))
