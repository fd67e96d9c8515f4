"""What a table does not tell is told by the scans: order of rotations, direction, unit and pairing, tried on all ways.

Three judges, from cheap to dear: the centroids of the clouds come to one point, the motions between neighbouring
scans close, the surfaces of all views fall together. The engine is that of `stitch check --deep`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.intake.alike import carried_over, distinct, same_stitch
from stitch.intake.cloud_pairs import Pairing
from stitch.intake.plausible_units import POSE_UNITS
from stitch.intake.readings import Reading
from stitch.intake.ways import MM, Way, all_ways
from stitch.integrity.centroids_meet import centroids_meet
from stitch.integrity.conventions import contenders, explained_by
from stitch.integrity.motion_fit import FEWEST, Explained
from stitch.integrity.relative_scans import RelativeScans
from stitch.integrity.surfaces_meet import CLEARER, Fallen, surfaces_meet
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
class Judged:
    """A way with what the scans say of it."""

    way: Way
    T_mount: Array  # (4, 4) mm
    misfit: float  # mm, rms distance between the views, truncated
    meets: bool  # some views overlap
    closed: float | None  # share of the scanner's motions that close; None where not asked


@dataclass(frozen=True)
class Decided:
    """The best way and the next; `told`: the scans tell them apart."""

    best: Judged
    runner_up: Judged | None
    told: bool
    alike: tuple[Way, ...]  # others that stitch alike: they differ from the best by one fixed frame
    scanner_away: float  # mm: of the scanner from the origin of its mount's frame
    part_away: float  # mm: of the part from the origin of the reference frame

    @property
    def scanner_at_flange(self) -> bool:
        """True if the scanner rather than the part sits at the flange."""
        return self.scanner_away <= self.part_away

    @property
    def mount_told(self) -> bool:
        """True if one of the two clearly sits nearer than the other."""
        low, high = sorted((self.scanner_away, self.part_away))
        return high > _NEARER * low


def decide(
    capture: Capture,
    motions: Callable[[], RelativeScans],
    found: Sequence[Reading],
    pairs: Sequence[Pairing],
    units: Sequence[str],
    carries: bool | None = None,
    shown: RelativeScans | None = None,
) -> Decided:
    """Try all ways; the motions, and pairings beside the first, only where the surfaces alone do not tell.

    Args:
        capture: the scans, mm; its poses do not count.
        motions: gives those between neighbouring scans, mm; dear.
        units: that positions can have of which the file does not say it.
        carries: whether the poses carry the mount's frame (see `Way`); None tries both.
        shown: motions between views that targets show, mm: where there are enough, they alone decide.
    """
    directions = (True, False) if carries is None else (carries,)
    if shown is not None and len(shown.pairs) >= FEWEST:
        paired = _of_right_unit(shown, all_ways(found, pairs, units, directions))
        return _decided(capture, paired, shown, by_targets=True)
    ways = all_ways(found, pairs[:1], units, directions)
    if len({way.length_unit for way in ways}) > 1:
        ways = _of_right_unit(motions(), ways)
    first = _decided(capture, ways, None)
    if not first.told:
        first = _decided(capture, ways, motions())
    if first.told or len(pairs) == 1:
        return first
    every = _decided(capture, _of_right_unit(motions(), all_ways(found, pairs, units, directions)), motions())
    # What is a guess anyway leaves out no view for it.
    whole = len(every.best.way.pairing.used) >= len(first.best.way.pairing.used)
    return every if every.told or (whole and every.best.misfit < first.best.misfit) else first


def _decided(capture: Capture, ways: Sequence[Way], motions: RelativeScans | None, by_targets: bool = False) -> Decided:
    tried = [way.hypothesis(i) for i, way in enumerate(ways)]
    meets = centroids_meet(tried, np.array([scan.points.mean(axis=0) for scan in capture.scans]))
    closing = {} if motions is None else {int(e.hypothesis.kind): e for e in explained_by(tried, motions, "mm")}
    by_motion = sorted(closing, key=lambda i: closing[i].open)
    by_centroid = sorted(range(len(ways)), key=lambda i: meets[i][0])
    by_motion = distinct(by_motion, tried, _SHORT)
    short = by_motion if by_targets else list(dict.fromkeys([*distinct(by_centroid, tried, _SHORT), *by_motion]))
    judged = []
    for i in steps("ways to read the poses", short):
        closed = closing.get(i)
        starts = [meets[i][1], *([closed.T_mount] if closed is not None and closed.closed >= _CLOSED else [])]
        judged.append(_judged(ways[i], surfaces_meet(capture, tried[i], starts), closed))
    if not by_targets:
        judged.sort(key=lambda j: j.misfit)
    best, runner_up = judged[0], judged[1] if len(judged) > 1 else None
    alone = _alone(list(closing.values()))
    clear = runner_up is None or runner_up.misfit >= CLEARER * best.misfit
    single = alone is not None and ways[alone] is best.way
    told = single if by_targets else (clear or single) and best.meets and len(best.way.pairing.used) > 2
    same = same_stitch(best.way, ways)
    best = replace(best, way=same[0], T_mount=carried_over(best.way, same[0], best.T_mount))
    return Decided(best, runner_up, bool(told), same[1:], *_sides(capture, best))


def _judged(way: Way, fallen: Fallen, closing: Explained | None) -> Judged:
    return Judged(way, fallen.T_mount, fallen.misfit, fallen.meets, None if closing is None else closing.closed)


def _alone(found: Sequence[Explained]) -> int | None:
    """The way that the motions alone single out, if they do."""
    close = contenders(found)
    return int(close[0].hypothesis.kind) if len(close) == 1 else None


def _of_right_unit(motions: RelativeScans, ways: Sequence[Way]) -> list[Way]:
    """The ways whose unit of length the motions of the scanner confirm; all where they say nothing."""
    units = {way.length_unit for way in ways}
    if len(units) == 1:
        return list(ways)
    first = {(way.reading.words, way.reading.layout.words, way.pairing, way.carries): way for way in ways[::-1]}
    plain = [replace(way, length_unit="mm") for way in first.values()]
    fitted = explained_by([w.hypothesis(i) for i, w in enumerate(plain)], motions, "mm", scaled=True)
    best = contenders([e for e in fitted if e.scale > 0])
    if not best:
        return list(ways)
    unit = min(units, key=lambda u: abs(np.log(best[0].scale * MM / POSE_UNITS[u])))
    near = abs(np.log(best[0].scale * MM / POSE_UNITS[unit])) < np.log(_UNIT_FACTOR)
    return [way for way in ways if way.length_unit == unit] if near else list(ways)


def _sides(capture: Capture, judged: Judged) -> tuple[float, float]:
    """How far the scanner lies from its mount's origin, and the part from that of the reference frame."""
    hypothesis = judged.way.hypothesis(0)
    poses = hypothesis.T_reference_mount @ judged.T_mount
    used = range(len(poses)) if hypothesis.used is None else hypothesis.used
    centres = [frames.transform(poses[v], capture.scans[v].points.mean(axis=0)[None])[0] for v in used]
    return float(np.linalg.norm(judged.T_mount[:3, 3])), float(np.linalg.norm(np.mean(centres, axis=0)))
