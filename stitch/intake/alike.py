"""Ways that stitch alike: poses that differ by one fixed frame before or behind them cannot be told apart by scans."""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.intake.ways import Way
from stitch.integrity.hypotheses import Hypothesis


def same_stitch(way: Way, ways: Sequence[Way]) -> tuple[Way, ...]:
    """All ways that stitch like one, itself included, in their order: the usual first."""
    own = way.hypothesis(0)
    same = [w for w in ways if w.carries == way.carries and _alike(w.hypothesis(0), own)]
    return tuple(same) or (way,)


def carried_over(way: Way, to: Way, T_mount: Array) -> Array:
    """The hand-eye (4, 4) of one way as that of another that stitches alike."""
    a, b = way.hypothesis(0), to.hypothesis(0)
    if way is to or _moves_alike(a, b):
        return T_mount
    first = way.pairing.used[0]
    return np.asarray(frames.inverse(b.T_reference_mount[first]) @ a.T_reference_mount[first] @ T_mount)


def distinct(ranked: Sequence[int], tried: Sequence[Hypothesis], most: int) -> list[int]:
    """The first few that move the scanner differently; of those that move it alike the first stays."""
    kept: list[int] = []
    for i in ranked:
        if len(kept) == most:
            break
        if not any(_alike(tried[i], tried[k]) for k in kept):
            kept.append(i)
    return kept


def _alike(a: Hypothesis, b: Hypothesis) -> bool:
    """Poses that differ by one fixed frame before or behind them stitch alike."""
    if a.used != b.used:
        return False
    A, B = _used(a), _used(b)
    behind = np.abs(A @ frames.inverse(A[:1]) - B @ frames.inverse(B[:1]))
    return _moves_alike(a, b) or _small(behind)


def _moves_alike(a: Hypothesis, b: Hypothesis) -> bool:
    A, B = _used(a), _used(b)
    return _small(np.abs(frames.inverse(A[:1]) @ A - frames.inverse(B[:1]) @ B))


def _used(h: Hypothesis) -> Array:
    return h.T_reference_mount if h.used is None else h.T_reference_mount[list(h.used)]


def _small(off: Array) -> bool:
    """Below a milliradian and a millimetre."""
    return bool(off[:, :3, :3].max() < 1e-3 and off[:, :3, 3].max() < 1.0)
