"""A tool, scanner, part or base that changed: at one view, or two lists of poses, or parts, that are mixed.

Where the robot's poses T_i carry the mount's frame and X is the hand-eye, another tool makes them T_i D for some of the
views, another base B T_i. The first shows in the hand-eyes of the two groups, the second in the motions between them.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.matching import sample_points
from stitch.plugins.intake.convention_choice import ConventionScore, Interpretation
from stitch.plugins.intake.layouts import MM
from stitch.plugins.intake.refusals import Fix, Refusal
from stitch.screening.conventions import fit_hypotheses
from stitch.screening.hypotheses import Hypothesis
from stitch.screening.linkage import CONTRADICTS, points_in_place
from stitch.screening.motions import (
    FEWEST,
    ROTATION,
    TRANSLATION_M,
    MotionFit,
    RelativeScans,
    fit_motions,
    rotation_angles,
)
from stitch.session.capture import Capture, part_size

# Motions of a group, and of all with the change undone, that close: scans of a symmetric part register wrongly now and
# then. Those that stay open are so much fewer than as it stands.
_FITS, _LESS_OPEN = 0.75, 0.5
# Views of a group, and readings tried of each half and of the whole.
_FEWEST_VIEWS = 3
_TRIED, _REFITS = 2, 2
# A change of less, mm and rad, is none.
_CHANGE_MM, _CHANGE_RAD = 1.0, 2e-3
# Two scans lie on each other where half of the points of either, on average, lie within this share of the part's size
# of the other; elsewhere is farther than so many times this, within reach.
_ON, _NEAR, _CLOSE, _REACH = 0.5, 0.01, 3.0, 0.1
# Points of a scan that are asked, and scans before and behind it in the list that they are held against.
_ASKED, _NEIGHBOURS = 300, 4


Groups = tuple[tuple[int, ...], tuple[int, ...], float]


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
    group = _linked(len(poses), [(v, w) for v, w in pairs if on[v, w] + on[w, v] >= 2 * _ON])
    largest = np.argsort(-np.bincount(group, minlength=2))[:2]
    first, second = (tuple(np.flatnonzero(group == k).tolist()) for k in largest)
    between = [max(elsewhere[v, w], elsewhere[w, v]) for v, w in pairs if v in first and w in second]
    return (first, second, float(np.median(between))) if len(second) >= _FEWEST_VIEWS and between else None


def require_one_part(clouds: Sequence[Path], groups: Groups, best: ConventionScore, rows: Sequence[int]) -> None:
    """Refuse scans of two groups that show the same surface at two places.

    Args:
        clouds: of the folder, in the order of their names.
        best: poses that fit.
        rows: of the scans among the clouds.

    Raises:
        InputError: names the scans of either group.
    """
    *sides, share = groups
    if share < CONTRADICTS:
        return
    names = [", ".join(clouds[rows[i]].name for i in side) for side in sides]
    told = (
        f"{clouds[0].parent}: two parts, or one that changed its shape: {names[0]} lie on each other, so do {names[1]}"
    )
    told += f"{names[1]}; {share:.0%} of the surface that either group shows of the other's it shows elsewhere"
    later = np.isin(np.arange(len(rows)), sides[1])
    raise Refusal(told, *_one_group_each(clouds, best.interpretation, rows, later))


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
    clouds: Sequence[Path], later: Mask, step: tuple[Array, str], undone: MotionFit, as_it_stands: MotionFit
) -> str:
    change, unit = step
    names = [cloud.name for cloud, is_later in zip(clouds, later, strict=True) if is_later]
    at_one = (np.diff(later.astype(int)) >= 0).all()
    told = f"a tool, the scanner, the part or the base changed at {names[0]}: the scans before it and those from it on"
    told = told if at_one else f"two lists of poses are mixed: {', '.join(names)} and the other scans"
    shift = ", ".join(f"{round(x, 1) + 0.0:.1f}" for x in change[:3, 3].tolist())
    turn = np.degrees(np.linalg.norm(frames.log(change[None])[0, :3]))
    told += f" fit each among themselves, by ({shift}) mm and {turn:.2f}° from another, with poses in {unit}"
    return (
        f"{clouds[0].parent}: {told}; with that undone {undone.closed:.0%} of the scanner's motions close, as it "
        f"stands {as_it_stands.closed:.0%}"
    )
