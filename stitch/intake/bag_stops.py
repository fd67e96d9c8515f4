"""Which scans of a bag were taken while the arm stood still: one of each stop."""

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices, Mask

# The arm stands if it turns (rad) and shifts (m) by less from this long (s) before to this long after.
AROUND = 0.2
_STILL_TURN, _STILL_SHIFT = 1e-3, 5e-4
# Two scans are of one stop if the flange has turned and shifted by less between them.
_SAME_TURN, _SAME_SHIFT = 2e-3, 1e-3


def stationary_scans(before: Array, at: Array, after: Array) -> Mask:
    """(M,) bool of flange poses (M, 4, 4); a pose that was not recorded is NaN and says nothing."""
    still = _is_recorded(at)
    for other in (before, after):
        both = np.flatnonzero(_is_recorded(other) & still)
        still[both] = _is_near(at[both], other[both], _STILL_TURN, _STILL_SHIFT)
    return still


def _is_recorded(T: Array) -> Mask:
    return np.asarray(np.isfinite(T).all(axis=(1, 2)), bool)


def middle_of_stops(T: Array, still: Mask) -> Indices:
    """Numbers of scans, in the order of time: the middle one of each stop.

    Args:
        T: (M, 4, 4) flange poses in the order of time.
    """
    groups: list[list[int]] = []
    for i in np.flatnonzero(still):
        last = groups[-1] if groups else None
        goes_on = last is not None and last[-1] == i - 1
        if last is not None and goes_on and _is_near(T[last[0]][None], T[i][None], _SAME_TURN, _SAME_SHIFT)[0]:
            last.append(int(i))
        else:
            groups.append([int(i)])
    return np.array([group[len(group) // 2] for group in groups], np.int64)


def _is_near(a: Array, b: Array, turn: float, shift: float) -> Mask:
    step = frames.log(frames.inverse(a) @ b)
    return np.asarray((np.linalg.norm(step[:, :3], axis=1) < turn) & (np.linalg.norm(step[:, 3:], axis=1) < shift))
