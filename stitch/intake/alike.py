"""Ways that stitch alike: poses that differ by one fixed frame before or behind them cannot be told apart by scans."""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.intake.ways import Interpretation
from stitch.integrity.hypotheses import Hypothesis


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
