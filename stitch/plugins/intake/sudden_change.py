"""What changed between the scans: a tool, scanner, part or base at one view, two lists of poses, or two parts.

Where the robot's poses T_i carry the mount's frame and X is the hand-eye, another tool makes them T_i D for some of the
views, another base B T_i. The first shows in the hand-eyes of the two groups, the second in the motions between them.
Of two parts, or one that changed its shape, the poses fit, since the scans of either group lie on each other; what one
group shows of the surface the other shows elsewhere.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.fit.coarse import SCORE_SHARE
from stitch.numerics import frames
from stitch.numerics.frames import Array, Mask
from stitch.observations.surfaces.matching import sample_points
from stitch.plugins.intake.convention_choice import ConventionScore, Interpretation
from stitch.plugins.intake.layouts import MM
from stitch.plugins.intake.refusals import Refusal
from stitch.screening.closing import CLEARLY_BETTER, surface_misfit
from stitch.screening.conventions import fit_hypotheses
from stitch.screening.hypotheses import Hypothesis
from stitch.screening.linkage import CONTRADICTS, linkage_of_pairs, points_in_place
from stitch.screening.motions import FEWEST, TRANSLATION_M, MotionFit, RelativeScans, alike, fit_motions
from stitch.screening.placement import surface_of
from stitch.session.capture import Capture, part_size

# Motions of a group, and of all with the change undone, that close: scans of a symmetric part register wrongly now and
# then. Those that stay open are so much fewer than as it stands, and more than one: a change explains any one motion.
_FITS, _LESS_OPEN = 0.75, 0.5
# Views of a group, and readings tried of each half and of the whole.
_FEWEST_VIEWS = 3
_TRIED, _REFITS = 2, 2
# Points of a scan that are asked how far the surface of another one is, or whether it lies on it.
_ASKED = 300
# A change of less, mm and rad, is none.
_CHANGE_MM, _CHANGE_RAD = 1.0, 2e-3
# Two scans lie on each other where half of the points of either, on average, lie within this share of the part's size
# of the other; elsewhere is farther than so many times this, within reach.
_ON, _NEAR, _CLOSE, _REACH = 0.5, 0.01, 3.0, 0.1
# Scans before and behind one in the list that it is held against.
_NEIGHBOURS = 4

Groups = tuple[tuple[int, ...], tuple[int, ...], float]


def require_no_change(
    clouds: Sequence[Path],
    scans: tuple[Capture, Sequence[int], RelativeScans],
    ways: Sequence[Interpretation],
    best: ConventionScore,
) -> None:
    """Refuse poses that fit in two groups and, with one change undone, as a whole; not as they stand.

    Scans of a part that looks alike from several sides register turned or slid on themselves, and their motions may
    close with any change undone: the scans themselves must lie nearer to each other with it undone.

    Args:
        clouds: of the folder, in the order of their names.
        scans: made light, mm, their numbers among the clouds, and the motions between them, mm.
        ways: to read the poses.
        best: the one under which the scans lie on each other best, as the poses stand.

    Raises:
        InputError: names the views, the size of the change and what it leaves.
    """
    capture, kept, motions = scans
    as_posed = fit_motions(best.interpretation.hypothesis(0), motions, TRANSLATION_M / MM)
    as_posed = replace(as_posed, T_mount=best.T_mount)
    count = len(kept)
    tried = [way.hypothesis(i) for i, way in enumerate(ways)]
    first = np.arange(count) < count // 2
    sides = (first, ~first, np.ones(count, bool))
    fits = [sorted(fit_hypotheses(tried, _among(motions, s), "mm"), key=lambda fit: fit.open)[:_TRIED] for s in sides]
    found = []
    for hypothesis in {fit.hypothesis.kind: fit.hypothesis for some in fits for fit in some}.values():
        as_it_stands = fit_motions(hypothesis, motions, TRANSLATION_M / MM)
        for later in _groups(as_it_stands, motions):
            change = _change_of(hypothesis, motions, later)
            if change is not None and _is_better(change[1].closed, as_it_stands.closed, len(motions.pairs)):
                found.append((change[1].open, later, change, as_it_stands))
    for _, later, (step, undone), as_it_stands in sorted(found, key=lambda one: one[0])[:_TRIED]:
        across = [(v, w) for v, w in motions.pairs if later[v] != later[w]] or motions.pairs
        apart = _apart(capture, undone, across)
        stands = min(_apart(capture, fit, across) for fit in (as_it_stands, as_posed))
        if apart * CLEARLY_BETTER < stands:
            way = ways[int(undone.hypothesis.kind)]
            left = (undone.closed, apart), (as_it_stands.closed, stands)
            told = _change_message([clouds[i] for i in kept], later, step, way.length_unit, left)
            raise Refusal(told, *way.pairing.one_session_each(kept, len(clouds), later))


def _apart(capture: Capture, fit: MotionFit, pairs: Sequence[tuple[int, int]]) -> float:
    """Return how far scans of some pairs lie apart along the normals, rms, mm, truncated, under the hand-eye near that
    of a fit that suits all best.

    Along the surface they may slide: what a part that looks alike from several sides does not show, this does not ask.
    """
    T_mount = surface_misfit(capture, fit.hypothesis, [fit.T_mount]).T_mount
    poses = fit.hypothesis.T_reference_mount @ T_mount
    limit = SCORE_SHARE * part_size([capture])
    squares = []
    for v, w in pairs:
        scan, asked = capture.scans[w], sample_points(capture.scans[w], _ASKED)
        surface = surface_of(capture.scans, poses, [v], 0.0)
        residual, _, meets, _ = surface.meets(poses[w : w + 1], scan.points[asked], scan.normals[asked], limit)
        squares.append(np.mean(np.where(meets, residual, limit) ** 2))
    return float(np.sqrt(np.mean(squares)))


def _is_better(closed: float, before: float, count: int) -> bool:
    """Whether so large a share of the motions closes, and so many fewer stay open than before."""
    return closed >= _FITS and 1 - closed <= _LESS_OPEN * (1 - before) and (closed - before) * count > 1.5


def _groups(fit: MotionFit, motions: RelativeScans) -> Iterator[Mask]:
    """Yield views of which something may have changed: from each on, every second, those that no closing motion links
    to the largest group."""
    T, X = fit.hypothesis.T_reference_mount, fit.T_mount
    count = len(T)
    yield from (np.arange(count) >= k for k in range(_FEWEST_VIEWS, count - _FEWEST_VIEWS + 1))
    yield np.arange(count) % 2 == 1
    v, w = np.array(motions.pairs).T
    for _ in range(_REFITS):
        closes = alike(T[v] @ X @ motions.T, T[w] @ X, TRANSLATION_M / MM)
        closing = RelativeScans(tuple(p for p, c in zip(motions.pairs, closes, strict=True) if c), motions.T[closes])
        X = fit_motions(fit.hypothesis, closing, TRANSLATION_M / MM).T_mount
    other = ~np.isin(np.arange(count), linkage_of_pairs(count, closing.pairs).core)
    if _FEWEST_VIEWS <= other.sum() <= count - _FEWEST_VIEWS:
        # The first few and no others: what changed, changed at the view behind them.
        yield other != other[0] if (np.diff(other.astype(int)) <= 0).all() else other


def _among(motions: RelativeScans, views: Mask) -> RelativeScans:
    kept = [i for i, pair in enumerate(motions.pairs) if views[list(pair)].all()]
    return RelativeScans(tuple(motions.pairs[i] for i in kept), motions.T[kept])


def _change_of(hypothesis: Hypothesis, motions: RelativeScans, later: Mask) -> tuple[Array, MotionFit] | None:
    """Return the change (4, 4), mm, and the fit with it undone; None where a group does not fit or nothing changed."""
    parts = [_among(motions, side) for side in (~later, later)]
    # Of few motions among the later views their own hand-eye is not known: only the base can have changed.
    fits = [fit_motions(hypothesis, part, TRANSLATION_M / MM) for part in parts if len(part.pairs) >= FEWEST]
    if len(parts[0].pairs) < FEWEST or min(fit.closed for fit in fits) < _FITS:
        return None
    X = fits[0].T_mount
    poses = hypothesis.T_reference_mount
    tool = X @ frames.inverse(fits[-1].T_mount)
    tried = [(tool, poses[later] @ frames.inverse(tool))]
    across = [(v, w, m) for (v, w), m in zip(motions.pairs, motions.T, strict=True) if later[v] != later[w]]
    steps = [poses[w] @ X @ frames.inverse(poses[v] @ X @ motion) for v, w, motion in across]
    bases = [step if later[w] else frames.inverse(step) for (_, w, _), step in zip(across, steps, strict=True)]
    if bases:
        base = min(bases, key=lambda one: sum(np.linalg.norm(one[:3, 3] - other[:3, 3]) for other in bases))
        tried.append((base, frames.inverse(base) @ poses[later]))
    undone = []
    for change, moved in tried:
        if _is_change(change):
            T = np.array(poses)
            T[later] = moved
            flange = T if hypothesis.mount == "eye_in_hand" else frames.inverse(T)
            fit = fit_motions(replace(hypothesis, T_base_flange=flange), motions, TRANSLATION_M / MM)
            undone.append((change, fit))
    return min(undone, key=lambda one: one[1].open, default=None)


def _is_change(T: Array) -> bool:
    step = frames.log(T[None])[0]
    return bool(np.linalg.norm(T[:3, 3]) > _CHANGE_MM or np.linalg.norm(step[:3]) > _CHANGE_RAD)


def _change_message(
    clouds: Sequence[Path], later: Mask, change: Array, unit: str, left: Sequence[tuple[float, float]]
) -> str:
    """Name a change (4, 4), mm.

    Args:
        left: the share of motions that close, and how far scans on either side of the change lie apart, mm: with it
            undone, and as it stands.
    """
    names = [cloud.name for cloud, is_later in zip(clouds, later, strict=True) if is_later]
    at_one = (np.diff(later.astype(int)) >= 0).all()
    told = f"a tool, the scanner, the part or the base changed at {names[0]}"
    told = told if at_one else f"two lists of poses are mixed, {', '.join(names)} and the other scans"
    shift = ", ".join(f"{round(x, 1) + 0.0:.1f}" for x in change[:3, 3].tolist())
    turn = np.degrees(np.linalg.norm(frames.log(change[None])[0, :3]))
    undone, stands = (f"{closed:.0%} of the scanner's motions close, scans {mm:.2g} mm apart" for closed, mm in left)
    told += f", by ({shift}) mm and {turn:.2f}°, with poses in {unit}"
    return f"{clouds[0].parent}: {told}; with that undone {undone}; as it stands {stands}"


def groups_apart(capture: Capture, best: ConventionScore) -> Groups | None:
    """Return two groups of views that lie on each other within each alone, or None.

    With them, of what either shows about the other's surface, the share that it shows elsewhere.
    """
    used = best.interpretation.pairing.used
    poses = best.interpretation.hypothesis(0).T_reference_mount @ best.T_mount
    pairs = [(v, w) for v in used for w in used if v != w and abs(v - w) <= _NEIGHBOURS]
    near, reach = part_size([capture]) * np.array([_NEAR, _REACH])
    on, elsewhere = np.zeros((2, len(poses), len(poses)))
    for v, w in pairs if len(used) >= 2 * _FEWEST_VIEWS else ():
        asked = sample_points(capture.scans[v], _ASKED)
        T = frames.inverse(poses[w]) @ poses[v]
        points = frames.transform(T, capture.scans[v].points[asked])
        normals = frames.rotate(T, capture.scans[v].normals[asked])
        there, close, about = (
            points_in_place(capture.scans[w], points, normals, away) for away in (near, _CLOSE * near, reach)
        )
        on[v, w] = there.mean()
        elsewhere[v, w] = (about & ~close).sum() / max(about.sum(), 1)
    linked = linkage_of_pairs(len(poses), [(v, w) for v, w in pairs if on[v, w] + on[w, v] >= 2 * _ON])
    first, second = (*linked.components, ())[:2]
    between = [max(elsewhere[v, w], elsewhere[w, v]) for v, w in pairs if v in first and w in second]
    return (first, second, float(np.median(between))) if len(second) >= _FEWEST_VIEWS and between else None


def require_one_part(clouds: Sequence[Path], groups: Groups, best: ConventionScore, kept: Sequence[int]) -> None:
    """Refuse scans of two groups that show the same surface at two places.

    Args:
        clouds: of the folder, in the order of their names.
        best: poses that fit.
        kept: numbers of the views among the clouds.

    Raises:
        InputError: names the scans of either group.
    """
    *sides, share = groups
    if share < CONTRADICTS:
        return
    first, second = (", ".join(clouds[kept[i]].name for i in side) for side in sides)
    told = (
        f"{clouds[0].parent}: two parts, or one that changed its shape: {first} lie on each other, and so do {second}; "
        f"{share:.0%} of the surface that either group shows of the other's it shows elsewhere"
    )
    later = np.isin(np.arange(len(kept)), sides[1])
    raise Refusal(told, *best.interpretation.pairing.one_session_each(kept, len(clouds), later))
