"""What a table does not tell is told by the scans: order of rotations, direction, unit and pairing, tried on all ways.

Three judges, from cheap to dear: the centroids of the clouds come to one point, the motions between neighbouring scans
close, the surfaces of all views fall together. The engine is that of `stitch check --deep`.

Scans cannot tell "the scanner at the flange" from "the part at the flange, poses inverted": both move alike. What
tells them apart is where things lie: what sits at the flange is near its origin, what stands in the cell is not near
that of the base.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.intake.cloud_pairs import Pairing
from stitch.plugins.intake.guesses import Because, Guess
from stitch.plugins.intake.layouts import MM, POSE_UNITS
from stitch.plugins.intake.readings import JOINT_ANGLES, Reading
from stitch.plugins.intake.refusals import Refusal, change, state
from stitch.screening.background import find_standing_scene
from stitch.screening.closing import CLEARLY_BETTER, fit_centroids, surface_misfit
from stitch.screening.conventions import equivalent_hypotheses, fit_hypotheses
from stitch.screening.hypotheses import Hypothesis
from stitch.screening.motions import FEWEST, TRANSLATION_M, RelativeScans, alike
from stitch.session.capture import Capture
from stitch.session.session import Mount
from stitch.system.process import steps

# Scanner or part sits at the flange if it lies this much nearer to its frame's origin than the other.
_NEARER = 1.5
_WORDS = {"eye_in_hand": "the scanner sits at the flange", "eye_to_hand": "the part sits at the flange"}
# Ways that the dear judge sees: the best of each cheap one.
_SHORT = 4
# Motions that closed give a start for the surfaces; and so many of them leave no doubt of a pairing.
_CLOSED, MOST_CLOSED = 0.5, 0.85
# Motions that close under one way, against those under the next: then the lead of surfaces that chance does not reach
# (see CLEARLY_BETTER) tells it.
_TWICE, BY_CHANCE = 1.9, 1.12
# Two rough fits of the same differ by so many milliradians, and millimetres.
_ROUGH = 5.0
# A fitted scale belongs to a unit within this factor: 10 and 25.4 lie 2.5 apart.
_UNIT_FACTOR = 1.5


@dataclass(frozen=True)
class Interpretation:
    """One way. `carries`: the poses as read take the mount's frame to the reference; else their inverse does."""

    reading: Reading
    pairing: Pairing
    length_unit: str
    carries: bool

    @property
    def T(self) -> Array:
        """Poses (V, 4, 4) of the clouds, mm; identity where a cloud has none."""
        scale = POSE_UNITS[self.length_unit] / MM
        out = np.tile(np.eye(4), (len(self.pairing.rows), 1, 1))
        for i, row in enumerate(self.pairing.rows):
            if row is not None:
                T = self.reading.T[row]
                out[i] = frames.make(T[:3, :3], T[:3, 3] * scale)
        return out

    def hypothesis(self, number: int) -> Hypothesis:
        """The same for the judges of integrity, which know it again by its number."""
        mount: Mount = "eye_in_hand" if self.carries else "eye_to_hand"
        complete = len(self.pairing.used) == len(self.pairing.rows)
        return Hypothesis(str(number), self.T, mount, "", used=None if complete else self.pairing.used)


def all_interpretations(
    readings: Iterable[Reading], pairs: Sequence[Pairing], units: Sequence[str], directions: Sequence[bool]
) -> list[Interpretation]:
    """Every combination, the usual first.

    Args:
        units: for readings of which the file does not tell it.
        directions: whether the poses carry the mount's frame.
    """
    ranked = sorted(readings, key=lambda r: r.rank)
    return [
        Interpretation(reading, pairing, unit, carries)
        for pairing in pairs
        for reading in ranked
        for unit in ([reading.layout.length_unit] if reading.layout.length_unit else units)
        for carries in directions
    ]


def equivalent_interpretations(
    interpretation: Interpretation, interpretations: Sequence[Interpretation]
) -> tuple[Interpretation, ...]:
    """All ways that stitch like one, itself included, in their order: the usual first."""
    own = interpretation.hypothesis(0)
    same = [w for w in interpretations if w.carries == interpretation.carries and _are_equivalent(w.hypothesis(0), own)]
    return tuple(same) or (interpretation,)


def transferred_hand_eye(interpretation: Interpretation, to: Interpretation, T_mount: Array) -> Array:
    """The hand-eye (4, 4) of one way as that of another that stitches alike."""
    a, b = interpretation.hypothesis(0), to.hypothesis(0)
    if interpretation is to or _same_scanner_motion(a, b):
        return T_mount
    first = interpretation.pairing.used[0]
    return np.asarray(frames.inverse(b.T_reference_mount[first]) @ a.T_reference_mount[first] @ T_mount)


def distinct_hypotheses(ranked: Sequence[int], tried: Sequence[Hypothesis], most: int) -> list[int]:
    """The first few that move the scanner differently; of those that move it alike the first stays."""
    kept: list[int] = []
    for i in ranked:
        if len(kept) == most:
            break
        if not any(_are_equivalent(tried[i], tried[k]) for k in kept):
            kept.append(i)
    return kept


def _are_equivalent(a: Hypothesis, b: Hypothesis) -> bool:
    """Poses that differ by one fixed frame before or behind them stitch alike."""
    if a.used != b.used:
        return False
    A, B = _used_poses(a), _used_poses(b)
    behind = np.abs(A @ frames.inverse(A[:1]) - B @ frames.inverse(B[:1]))
    return _same_scanner_motion(a, b) or _small(behind)


def _same_scanner_motion(a: Hypothesis, b: Hypothesis) -> bool:
    A, B = _used_poses(a), _used_poses(b)
    return _small(np.abs(frames.inverse(A[:1]) @ A - frames.inverse(B[:1]) @ B))


def _used_poses(h: Hypothesis) -> Array:
    return h.T_reference_mount if h.used is None else h.T_reference_mount[list(h.used)]


def _small(off: Array) -> bool:
    """Below a milliradian and a millimetre."""
    return bool(off[:, :3, :3].max() < 1e-3 and off[:, :3, 3].max() < 1.0)


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
    overruled: str = ""  # the reading that the names of the columns tell, where the scans contradict it
    only_believed: str = ""  # another reading under which the views meet as well as under the one that names tell


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
    rows = {row for pairing in pairs for row in pairing.rows}
    # Under a pairing that goes wrong in the middle the motions before it close all the same.
    closes = first.best.closed is None or first.best.closed >= MOST_CLOSED
    nothing_left = None not in pairs[0].rows and len({*pairs[0].rows}) == len(rows | {*pairs[0].rows})
    if len(pairs) == 1 or (first.determined and nothing_left and closes):
        return first
    every = _choose_interpretation(
        capture, _with_confirmed_unit(motions(), all_interpretations(readings, pairs, units, directions)), motions()
    )
    # What is a guess anyway leaves out no view for it.
    whole = len(every.best.interpretation.pairing.used) >= len(first.best.interpretation.pairing.used)
    return every if every.determined or (whole and every.best.misfit < first.best.misfit) else first


def weigh_doubts(believed: ConventionChoice, doubted: ConventionChoice) -> ConventionChoice:
    """Return what the names of columns tell, or the reading against them that the scans ask for.

    Args:
        doubted: the choice among readings against the names, or with an axis or a coupling taken into account.
    """
    own, other = believed.best, doubted.best
    better = other.misfit * CLEARLY_BETTER < own.misfit
    if doubted.determined and better and not believed.determined:
        return replace(doubted, overruled=own.interpretation.reading.words)
    if other.meets and other.misfit < own.misfit * CLEARLY_BETTER:
        return replace(believed, only_believed=other.interpretation.reading.words)
    return believed


def choose_by_surfaces(capture: Capture, readings: Sequence[Reading], like: Interpretation) -> ConventionChoice:
    """Choose among readings by the surfaces alone, paired, in the unit and the direction of a way that is believed."""
    ways = all_interpretations(readings, [like.pairing], [like.length_unit], [like.carries])
    return _choose_interpretation(capture, ways, None)


def fitted_scale(
    motions: RelativeScans, ways: Sequence[Interpretation], sizes: Sequence[float] = (1.0,)
) -> float | None:
    """Return how many times larger than the robot's motions the scans are; None where the motions do not tell it.

    Args:
        sizes: of the scans against the robot's motions, from which the factor is fitted.
    """
    tried = [way.hypothesis(i) for i, way in enumerate(ways)]
    found = []
    for size in sizes:
        # What a motion may leave open is stated for scans of the true size.
        T = frames.make(motions.T[:, :3, :3], motions.T[:, :3, 3] / size)
        fitted = fit_hypotheses(tried, RelativeScans(motions.pairs, T), "mm", scaled=True)
        best = equivalent_hypotheses([fit for fit in fitted if fit.scale > 0])
        found += [(best[0].open, best[0].scale * size)] if best else []
    return min(found)[1] if found else None


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
        fit = surface_misfit(capture, tried[i], starts)
        share = None if closed is None else closed.closed
        judged.append(ConventionScore(interpretations[i], fit.T_mount, fit.misfit, fit.meets, share))
    if not by_targets:
        judged.sort(key=lambda j: j.misfit)
    best = judged[0]
    runner_up = next((other for other in judged[1:] if by_targets or not _stitch_alike(best, other)), None)
    clear = runner_up is None or runner_up.misfit >= CLEARLY_BETTER * best.misfit
    # The motions alone single a way out.
    close = equivalent_hypotheses(list(closing.values()))
    leads = bool(close) and interpretations[int(close[0].hypothesis.kind)] is best.interpretation
    single = leads and len(close) == 1
    # Both judges put the same way first, each by more than chance does.
    agreed = leads and all(_TWICE * fit.closed <= close[0].closed for fit in close[1:])
    clear |= agreed and runner_up is not None and runner_up.misfit >= BY_CHANCE * best.misfit
    told = single if by_targets else (clear or single) and best.meets and len(best.interpretation.pairing.used) > 2
    same = equivalent_interpretations(best.interpretation, interpretations)
    best = replace(
        best, interpretation=same[0], T_mount=transferred_hand_eye(best.interpretation, same[0], best.T_mount)
    )
    return ConventionChoice(best, runner_up, bool(told), same[1:], *_flange_distances(capture, best))


def _stitch_alike(best: ConventionScore, other: ConventionScore) -> bool:
    """Whether the hand-eyes of two ways place the views alike, as those of turns about one axis do, either way round.

    Asked only where half of the motions close: a way that does not fit is not certain for want of another.
    """
    a, b = best.interpretation.hypothesis(0), other.interpretation.hypothesis(0)
    if (best.closed or 0.0) < _CLOSED or a.used != b.used:
        return False
    A, B = _used_poses(a) @ best.T_mount, _used_poses(b) @ other.T_mount
    return _small(np.abs(frames.inverse(A[:1]) @ A - frames.inverse(B[:1]) @ B) / _ROUGH)


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


def require_no_background(folder: Path, capture: Capture, scale: float) -> None:
    """Refuse scans that mostly show what stands still before the scanner, where a box parts it from the rest.

    Args:
        capture: the scans, mm.
        scale: unit of the clouds, mm.

    Raises:
        InputError: with the box that holds the part alone.
    """
    found = find_standing_scene(capture.scans)
    if found is None:
        return
    share, box = found
    corners = ",".join(f"{x / scale:.4g}" for x in box.ravel())
    told = f"{folder}: {share:.0%} of what the scans show stands still before the scanner: a table, a wall"
    raise Refusal(told, state(within=corners))


def require_own_frames(folder: Path, motions: Callable[[], RelativeScans], decided: ConventionChoice) -> None:
    """Refuse scans that no reading of the poses brings together, and most of which meet their neighbours as they are.

    Args:
        motions: between neighbouring scans, mm; asked only where the scans do not tell the reading.

    Raises:
        InputError: the scans hardly move against each other, and not as the poses do.
    """
    if decided.determined:
        return
    T = motions().T
    if len(T) < FEWEST:
        return
    still = float(alike(T, np.eye(4), TRANSLATION_M / MM).mean())
    if still > max(0.5, decided.best.closed or 0.0):
        raise Refusal(
            f"{folder}: {still:.0%} of neighbouring scans meet as they are, and not as the poses say: they lie in one "
            "frame already, or most of what they show stands still before the scanner",
            change(folder, "export every scan in the scanner's own frame, or cut away what stands still"),
        )


def choose_mounting(decided: ConventionChoice, mount: str | None, inverse: bool | None) -> tuple[str, bool, Guess]:
    """Return the mount, whether the table holds T_flange_base, and why: as stated, else by where things lie.

    Args:
        mount, inverse: as stated; None where they are not.
    """
    reading = decided.best.interpretation.reading
    of_joints = reading.rotation == JOINT_ANGLES
    direct = "eye_in_hand" if decided.best.interpretation.carries else "eye_to_hand"
    other = "eye_to_hand" if decided.best.interpretation.carries else "eye_in_hand"
    away = (decided.scanner_away, decided.part_away)
    scanner, part = (f"{mm:.0f} mm" for mm in away)
    placed = (
        f"under it the scanner lies {scanner} from the origin of its frame and the part {part} from that of its own"
    )
    told = True
    by: Because = "file"
    if mount is not None:
        chosen, reason = mount, "stated with --mount"
    elif reading.layout.turntable:
        chosen, reason = "eye_to_hand", "a turntable carries the part"
    elif inverse is not None or of_joints:
        chosen = other if inverse else direct
        reason = "the direction of the poses is " + ("stated" if inverse is not None else "known from joint angles")
    elif decided.determined and max(away) > _NEARER * min(away):
        chosen = "eye_in_hand" if min(away) == decided.scanner_away else "eye_to_hand"
        reason = f"{placed}: what lies nearer sits at the flange"
        by = "usual"
    elif decided.determined:
        chosen, reason, told = direct, f"{placed}; poses are usually those of the flange in the base", False
    else:
        chosen, reason, told = direct, "as poses usually are", False
    inverted = chosen != direct
    value = f"{chosen}, {_WORDS[chosen]}; the poses are {'T_flange_base' if inverted else 'T_base_flange'}"
    rest = other if chosen == direct else direct
    runner_up = f"{rest} with poses {'inverted' if not inverted else 'as they are'}" if mount is None else None
    guess = Guess("mount", value, reason, told, "--mount", runner_up, by, None, {"mount": chosen}, {"mount": rest})
    return chosen, inverted, guess
