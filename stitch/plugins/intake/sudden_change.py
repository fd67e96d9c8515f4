"""A tool, scanner, part or base that changed: at one view, or two lists of poses, or parts, that are mixed.

Where the robot's poses T_i carry the mount's frame and X is the hand-eye, another tool makes them T_i D for some of the
views, another base B T_i. The first shows in the hand-eyes of the two groups, the second in the motions between them.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.plugins.intake.convention_choice import ConventionScore, Interpretation
from stitch.plugins.intake.layouts import MM
from stitch.plugins.intake.refusals import Fix, Refusal
from stitch.screening.conventions import fit_hypotheses
from stitch.screening.hypotheses import Hypothesis
from stitch.screening.linkage import Linkage
from stitch.screening.motions import (
    FEWEST,
    ROTATION,
    TRANSLATION_M,
    MotionFit,
    RelativeScans,
    fit_motions,
    rotation_angles,
)
from stitch.screening.placement import place_groups
from stitch.session.capture import Capture

# Motions of a group, and of all with the change undone, that close: scans of a symmetric part register wrongly now and
# then. Those that stay open are so much fewer than as it stands.
_FITS, _LESS_OPEN = 0.75, 0.5
# Views of a group, and readings tried of each half and of the whole.
_FEWEST_VIEWS = 3
_TRIED, _REFITS = 2, 2
# A change of less, mm and rad, is none.
_CHANGE_MM, _CHANGE_RAD = 1.0, 2e-3
# Two scans lie on each other where half of the points of either, on average, lie within this share of the part's size
# of the other. Where a point lies nearer to a scanner than what it saw there, by this share, one of both was not there.
_ON, _NEAR, _BEFORE = 0.5, 0.01, 0.05
# One part at two places lies on itself, once it is moved back, nearly as its scans do at one place.
_AS_ONE = 0.93
# Shares of such points, in the middle of all pairs: between the groups at least, within them at most.
_BETWEEN, _WITHIN = 0.04, 0.015
# Points of a scan that are asked, and scans before and behind it in the list that they are held against.
_ASKED, _NEIGHBOURS = 300, 4


def require_one_part(clouds: Sequence[Path], capture: Capture, best: ConventionScore, rows: Sequence[int]) -> None:
    """Refuse scans of two groups that lie on each other within each, and not between them, where they show one place.

    Args:
        clouds: of the folder, in the order of their names.
        best: poses that fit.
        rows: of the capture's scans among the clouds.

    Raises:
        InputError: names the scans of either group.
    """
    poses = best.interpretation.hypothesis(0).T_reference_mount @ best.T_mount
    groups = _groups_apart(capture, poses, best.interpretation.pairing.used)
    if groups is None:
        return
    first, second, share = groups
    names = [", ".join(clouds[rows[i]].name for i in np.flatnonzero(side).tolist()) for side in (first, second)]
    told = (
        f"{names[0]} lie on each other, so do {names[1]}; between the two groups {share:.0%} of the points lie before "
    )
    told += "what the other saw"
    step, apart, within = _step_between(capture, poses, first, second)
    if apart < _AS_ONE * within:
        told = f"two parts, or one that changed its shape: {told}; brought as near as one step can, {apart:.0%} of the "
        told += f"points lie on the other group, {within:.0%} within each"
    else:
        shift = ", ".join(f"{round(x, 1) + 0.0:.1f}" for x in step[:3, 3].tolist())
        turn = np.degrees(np.linalg.norm(frames.log(step[None])[0, :3]))
        told = f"the part or the base changed its place: {told}, unless moved by ({shift}) mm and {turn:.2f}°"
    raise Refusal(f"{clouds[0].parent}: {told}", *_one_group_each(clouds, best.interpretation, rows, second))


def _groups_apart(capture: Capture, poses: Array, used: Sequence[int]) -> tuple[Mask, Mask, float] | None:
    """Return two groups of views that contradict each other, and in what share of points; None of one part."""
    pairs = [(v, w) for v in used for w in used if v != w and abs(v - w) <= _NEIGHBOURS]
    if len(used) < 2 * _FEWEST_VIEWS:
        return None
    scans = [scan.points for scan in capture.scans]
    on = _lying_on(capture, poses, pairs)
    group = _linked(len(scans), [(v, w) for v, w in pairs if on[v, w] >= _ON])
    first, second = (group == k for k in np.argsort(-np.bincount(group, minlength=2))[:2])
    if min(first.sum(), second.sum()) < _FEWEST_VIEWS:
        return None
    sights = [cKDTree(points / np.linalg.norm(points, axis=1, keepdims=True)) for points in scans]
    before = np.zeros((len(scans), len(scans)))
    for v, w in pairs:
        points = _seen_from(capture, poses, v, w)
        away = np.linalg.norm(points, axis=1)
        aside, seen = sights[w].query(points / away[:, None])
        nearer = np.linalg.norm(scans[w][seen], axis=1) - away > _BEFORE * _scan_size(capture)
        before[v, w] = (nearer & (aside * away < _NEAR * _scan_size(capture))).mean()
    between = [max(before[v, w], before[w, v]) for v, w in pairs if first[v] and second[w]]
    within = [before[v, w] for v, w in pairs if group[v] == group[w]]
    apart = bool(between) and np.median(between) >= _BETWEEN and np.median(within) <= _WITHIN
    return (first, second, float(np.median(between))) if apart else None


def _lying_on(capture: Capture, poses: Array, pairs: Sequence[tuple[int, int]]) -> Array:
    """Return (V, V) of pairs of views the share of points of either that lie on the other, on average."""
    trees = [cKDTree(scan.points) for scan in capture.scans]
    near = _NEAR * _scan_size(capture)
    on = np.zeros((len(poses), len(poses)))
    for v, w in pairs:
        on[v, w] = (trees[w].query(_seen_from(capture, poses, v, w))[0] < near).mean()
    return (on + on.T) / 2


def _seen_from(capture: Capture, poses: Array, v: int, w: int) -> Array:
    """Return some points of the view v in the scanner's frame of the view w."""
    points = capture.scans[v].points
    return frames.transform(frames.inverse(poses[w]) @ poses[v], points[:: -(-len(points) // _ASKED)])


def _step_between(capture: Capture, poses: Array, first: Mask, second: Mask) -> tuple[Array, float, float]:
    """Return the one step (4, 4) that brings the second group nearest to the first.

    And what share of the points of one group lie on the other then, and within each, in the middle of all pairs.
    """
    parts = tuple(tuple(np.flatnonzero(side).tolist()) for side in (first, second))
    across = [pair for v in parts[0] for w in parts[1] for pair in ((v, w), (w, v))]
    centres = np.array(
        [frames.transform(T, scan.points).mean(axis=0) for T, scan in zip(poses, capture.scans, strict=True)]
    )
    inside = [(v, w) for part in parts for v in part for w in part if v != w]
    on = _lying_on(capture, poses, inside)
    best = np.eye(4), 0.0
    for shift in (centres[first].mean(axis=0) - centres[second].mean(axis=0), np.zeros(3)):
        moved = np.array(poses)
        moved[second, :3, 3] += shift
        limits = (_NEAR * _scan_size(capture), _FITS)
        for placement in [*place_groups(capture, moved, Linkage(len(poses), parts, ()), limits).values()][:1]:
            step = placement.T @ frames.inverse(poses[parts[1][0]])
            moved[second] = step @ poses[second]
            lying = _lying_on(capture, moved, across)
            best = max(best, (step, float(np.median([lying[pair] for pair in across]))), key=lambda one: one[1])
    return *best, float(np.median([on[pair] for pair in inside]))


def _scan_size(capture: Capture) -> float:
    """The diagonal of the box of a scan, in the middle of all."""
    return float(np.median([np.linalg.norm(np.ptp(scan.points, axis=0)) for scan in capture.scans]))


def require_no_change(
    clouds: Sequence[Path], motions: RelativeScans, ways: Sequence[Interpretation], kept: Sequence[int]
) -> None:
    """Refuse poses that fit in two groups and, with one change undone, as a whole; not as they stand.

    Args:
        clouds: of the folder, in the order of their names.
        kept: numbers of the views among them.
        motions: of the scans, mm.
        ways: to read the poses.

    Raises:
        InputError: names the views, the size of the change and what it leaves.
    """
    count = len(kept)
    tried = [way.hypothesis(i) for i, way in enumerate(ways) if len(way.pairing.used) == count]
    first = np.arange(count) < count // 2
    sides = (first, ~first, np.ones(count, bool))
    fits = [sorted(fit_hypotheses(tried, _among(motions, s), "mm"), key=lambda fit: fit.open)[:_TRIED] for s in sides]
    found = []
    for hypothesis in {fit.hypothesis.kind: fit.hypothesis for some in fits for fit in some}.values():
        as_it_stands = fit_motions(hypothesis, motions, TRANSLATION_M / MM)
        for later in _groups(as_it_stands, motions):
            change = _change_of(hypothesis, motions, later)
            if (
                change is not None
                and change[1].closed >= _FITS
                and 1 - change[1].closed <= _LESS_OPEN * (1 - as_it_stands.closed)
            ):
                found.append((change[1].open, later, change, as_it_stands))
    if found:
        _, later, (step, undone), as_it_stands = min(found, key=lambda one: one[0])
        unit = ways[0].length_unit
        told = _change_message([clouds[i] for i in kept], later, (step, unit), undone, as_it_stands)
        raise Refusal(told, *_one_group_each(clouds, ways[0], kept, later))


def _groups(fit: MotionFit, motions: RelativeScans) -> Iterator[Mask]:
    """Yield views of which something may have changed: from each on, every second, those that no closing motion links
    to the largest group."""
    T, X = fit.hypothesis.T_reference_mount, fit.T_mount
    count = len(T)
    yield from (np.arange(count) >= k for k in range(_FEWEST_VIEWS, count - _FEWEST_VIEWS + 1))
    yield np.arange(count) % 2 == 1
    v, w = np.array(motions.pairs).T
    for _ in range(_REFITS):
        off = frames.inverse(T[v] @ X @ motions.T) @ T[w] @ X
        closes = (rotation_angles(off) < ROTATION) & (np.linalg.norm(off[:, :3, 3], axis=1) < TRANSLATION_M / MM)
        closing = RelativeScans(tuple(p for p, c in zip(motions.pairs, closes, strict=True) if c), motions.T[closes])
        X = fit_motions(fit.hypothesis, closing, TRANSLATION_M / MM).T_mount
    group = _linked(count, zip(v[closes], w[closes], strict=True))
    other = group != np.bincount(group).argmax()
    if _FEWEST_VIEWS <= other.sum() <= count - _FEWEST_VIEWS:
        # The first few and no others: what changed, changed at the view behind them.
        yield other != other[0] if (np.diff(other.astype(int)) <= 0).all() else other


def _linked(count: int, links: Iterable[tuple[int, int]]) -> Indices:
    """Return for each view the number of its group, of those that links join."""
    group = np.arange(count)
    for a, b in links:
        group[group == group[b]] = group[a]
    return np.unique(group, return_inverse=True)[1]


def _one_group_each(clouds: Sequence[Path], way: Interpretation, kept: Sequence[int], later: Mask) -> list[Fix]:
    """Sessions of the views of either group."""
    words = ("make one session of the first scans", "another of the others")
    of_cloud = dict(zip(kept, zip(way.pairing.rows, later, strict=True), strict=True))
    each = [of_cloud.get(i, (None, False)) for i in range(len(clouds))]
    rows = [
        ",".join(str(row + 1) if row is not None and late == side else "-" for row, late in each)
        for side in (False, True)
    ]
    return [
        Fix(f"{told}, --rows={row} -o {name}", {"rows": row, "output": name})
        for told, row, name in zip(words, rows, ("before", "after"), strict=True)
    ]


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
    before = fits[0]
    T = np.array(hypothesis.T_reference_mount)
    change = before.T_mount @ frames.inverse(fits[-1].T_mount)
    if _is_change(change):
        T[later] = T[later] @ frames.inverse(change)
    else:
        X = before.T_mount
        across = [(v, w, m) for (v, w), m in zip(motions.pairs, motions.T, strict=True) if later[v] != later[w]]
        steps = [T[w] @ X @ frames.inverse(T[v] @ X @ motion) for v, w, motion in across]
        bases = [step if later[w] else frames.inverse(step) for (_, w, _), step in zip(across, steps, strict=True)]
        if not bases:
            return None
        change = min(bases, key=lambda base: sum(np.linalg.norm(base[:3, 3] - other[:3, 3]) for other in bases))
        T[later] = frames.inverse(change) @ T[later]
    if not _is_change(change):
        return None
    flange = T if hypothesis.mount == "eye_in_hand" else frames.inverse(T)
    return change, fit_motions(replace(hypothesis, T_base_flange=flange), motions, TRANSLATION_M / MM)


def _is_change(T: Array) -> bool:
    step = frames.log(T[None])[0]
    return bool(np.linalg.norm(T[:3, 3]) > _CHANGE_MM or np.linalg.norm(step[:3]) > _CHANGE_RAD)


def _change_message(
    clouds: Sequence[Path], later: Mask, step: tuple[Array, str], undone: MotionFit, as_it_stands: MotionFit
) -> str:
    change, unit = step
    shift = ", ".join(f"{round(x, 1) + 0.0:.1f}" for x in change[:3, 3].tolist())
    turn = np.degrees(np.linalg.norm(frames.log(change[None])[0, :3]))
    names = [cloud.name for cloud, is_later in zip(clouds, later, strict=True) if is_later]
    at_one = (np.diff(later.astype(int)) >= 0).all()
    told = f"a tool, the scanner, the part or the base changed at {names[0]}: the scans before it and those from it on"
    told = told if at_one else f"two lists of poses are mixed: {', '.join(names)} and the other scans"
    told += f" fit each among themselves, by ({shift}) mm and {turn:.2f}° from another, with poses in {unit}"
    return (
        f"{clouds[0].parent}: {told}; with that undone {undone.closed:.0%} of the scanner's motions close, as it "
        f"stands {as_it_stands.closed:.0%}"
    )
