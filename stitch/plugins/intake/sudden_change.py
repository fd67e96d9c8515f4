"""A tool, scanner, part or base that changed at one view: the views before it and those from it on fit, not both.

Where the robot's poses T_i carry the mount's frame and X is the hand-eye, another tool makes them T_i D from view k on,
another base B T_i. The first shows in the hand-eyes of the two parts, the second in the motions across view k.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.intake.convention_choice import Interpretation
from stitch.plugins.intake.layouts import MM
from stitch.plugins.intake.refusals import Fix, Refusal
from stitch.screening.conventions import fit_hypotheses
from stitch.screening.hypotheses import Hypothesis
from stitch.screening.motions import FEWEST, TRANSLATION_M, MotionFit, RelativeScans, fit_motions

# Motions of a part, and of all with the change undone, that close: scans of a symmetric part register wrongly now and
# then. Those that stay open are so much fewer than as it stands.
_FITS, _LESS_OPEN = 0.75, 0.5
# Views of a part, and readings tried of each half.
_FEWEST_VIEWS = 3
_TRIED = 2
# A change of less, mm and rad, is none.
_CHANGE_MM, _CHANGE_RAD = 1.0, 2e-3


def require_no_change(clouds: Sequence[Path], motions: RelativeScans, ways: Sequence[Interpretation]) -> None:
    """Refuse poses that fit in two parts and, with one change undone, as a whole; not as they stand.

    Args:
        clouds: in the order of the views.
        motions: of the scans, mm.
        ways: to read the poses.

    Raises:
        InputError: names the view, the size of the change and what it leaves.
    """
    count = len(clouds)
    halves = [_within(motions, 0, count // 2), _within(motions, count // 2, count)]
    tried = [way.hypothesis(i) for i, way in enumerate(ways) if len(way.pairing.used) == count]
    fits = [sorted(fit_hypotheses(tried, half, "mm"), key=lambda fit: fit.open)[:_TRIED] for half in halves]
    found = []
    for hypothesis in {fit.hypothesis.kind: fit.hypothesis for half in fits for fit in half}.values():
        as_it_stands = fit_motions(hypothesis, motions, TRANSLATION_M / MM)
        for k in range(_FEWEST_VIEWS, count - _FEWEST_VIEWS + 1):
            change = _change_at(hypothesis, motions, k)
            if (
                change is not None
                and change[1].closed >= _FITS
                and 1 - change[1].closed <= _LESS_OPEN * (1 - as_it_stands.closed)
            ):
                found.append((change[1].open, k, change, as_it_stands))
    if found:
        _, k, (step, undone), as_it_stands = min(found, key=lambda one: one[0])
        raise Refusal(_change_message(clouds, k, step, undone, as_it_stands), *_one_part_each(count, k))


def _one_part_each(count: int, k: int) -> list[Fix]:
    """Sessions of the views before the change, and of those from it on."""
    first, last = f"1-{k}{',-' * (count - k)}", f"{'-,' * k}{k + 1}-{count}"
    words = ("make one session of the scans before it", "another of those from it on")
    return [
        Fix(f"{told}, --rows={rows} -o {name}", {"rows": rows, "output": name})
        for told, rows, name in zip(words, (first, last), ("before", "after"), strict=True)
    ]


def _within(motions: RelativeScans, first: int, end: int) -> RelativeScans:
    kept = [i for i, pair in enumerate(motions.pairs) if first <= min(pair) and max(pair) < end]
    return RelativeScans(tuple(motions.pairs[i] for i in kept), motions.T[kept])


def _change_at(hypothesis: Hypothesis, motions: RelativeScans, k: int) -> tuple[Array, MotionFit] | None:
    """Return the change (4, 4), mm, and the fit with it undone; None where a part does not fit or nothing changed."""
    count = len(hypothesis.T_reference_mount)
    parts = [_within(motions, 0, k), _within(motions, k, count)]
    if min(len(part.pairs) for part in parts) < FEWEST:
        return None
    before, after = (fit_motions(hypothesis, part, TRANSLATION_M / MM) for part in parts)
    if min(before.closed, after.closed) < _FITS:
        return None
    T = np.array(hypothesis.T_reference_mount)
    tool = before.T_mount @ frames.inverse(after.T_mount)
    if _is_change(tool):
        T[k:] = T[k:] @ frames.inverse(tool)
        change = tool
    else:
        across = [i for i, (v, w) in enumerate(motions.pairs) if v < k <= w]
        X = before.T_mount
        bases = [
            T[w] @ frames.inverse(T[v] @ X @ motions.T[i] @ frames.inverse(X))
            for i, (v, w) in zip(across, (motions.pairs[i] for i in across), strict=True)
        ]
        if not bases:
            return None
        change = min(bases, key=lambda base: sum(np.linalg.norm(base[:3, 3] - other[:3, 3]) for other in bases))
        T[k:] = frames.inverse(change) @ T[k:]
    if not _is_change(change):
        return None
    flange = T if hypothesis.mount == "eye_in_hand" else frames.inverse(T)
    return change, fit_motions(replace(hypothesis, T_base_flange=flange), motions, TRANSLATION_M / MM)


def _is_change(T: Array) -> bool:
    step = frames.log(T[None])[0]
    return bool(np.linalg.norm(T[:3, 3]) > _CHANGE_MM or np.linalg.norm(step[:3]) > _CHANGE_RAD)


def _change_message(clouds: Sequence[Path], k: int, change: Array, undone: MotionFit, as_it_stands: MotionFit) -> str:
    shift = ", ".join(f"{x + 0.0:.1f}" for x in change[:3, 3])
    turn = np.degrees(np.linalg.norm(frames.log(change[None])[0, :3]))
    return (
        f"{clouds[0].parent}: a tool, the scanner, the part or the base changed at {clouds[k].name}: the scans before "
        f"it and those from it on fit each among themselves, by ({shift}) mm and {turn:.2f}° from another; with that "
        f"undone {undone.closed:.0%} of the scanner's motions close, as it stands {as_it_stands.closed:.0%}"
    )
