"""Few views, then little travel: greedy choice, exchange, what is not needed left out, driven the short way round."""

from collections.abc import Sequence

import numpy as np

from stitch.frames import Array
from stitch.planning.goals import Goal, mean_progress, present_progress

# Reached, but for rounding; and what a view must bring to be worth taking.
_REACHED, _WORTH = 1 - 1e-6, 0.01
# Among views that bring nearly the same the nearest is taken.
_NEARLY = 0.95
_SWEEPS = 2


def choose_views(goals: Sequence[Goal], joints: Array, present: int, most: int) -> list[int]:
    """Indices of further views, in the order in which they are driven.

    Args:
        joints: (N, n) of all views: those that are there first.
        present: how many these are.
        most: views at the most.
    """
    before, chosen = list(range(present)), list[int]()
    now = present_progress(goals, before)
    while len(chosen) < most and now < _REACHED:
        others = [k for k in range(present, len(joints)) if k not in chosen]
        if not others:
            break
        gained = mean_progress(goals, [*before, *chosen], others)
        if gained.max() - now < _WORTH:
            break
        k = _nearest_worthwhile(others, gained, now, joints, [*before, *chosen][-1])
        chosen.append(k)
        now = float(gained[others.index(k)])
    for _ in range(_SWEEPS):
        chosen, now = _exchange_views(goals, joints, before, chosen, now)
    return travel_order(joints, present - 1, _without_redundant(goals, before, chosen, now))


def _nearest_worthwhile(others: Sequence[int], gained: Array, now: float, joints: Array, last: int) -> int:
    good = np.flatnonzero(gained - now >= _NEARLY * (gained.max() - now))
    travel = [float(np.abs(joints[others[int(i)]] - joints[last]).sum()) for i in good]
    return others[int(good[np.argmin(travel)])]


def _exchange_views(
    goals: Sequence[Goal], joints: Array, before: list[int], chosen: list[int], now: float
) -> tuple[list[int], float]:
    """Every chosen view against the best in its place."""
    for i in range(len(chosen)):
        rest = chosen[:i] + chosen[i + 1 :]
        others = [k for k in range(len(before), len(joints)) if k not in rest]
        gained = mean_progress(goals, [*before, *rest], others)
        best = int(gained.argmax())
        if gained[best] > now + _WORTH:
            chosen, now = [*rest[:i], others[best], *rest[i:]], float(gained[best])
    return chosen, now


def _without_redundant(goals: Sequence[Goal], before: list[int], chosen: list[int], now: float) -> list[int]:
    """Without the views that the others make idle."""
    for k in list(chosen):
        rest = [other for other in chosen if other != k]
        if rest and present_progress(goals, [*before, *rest]) >= min(now, _REACHED):
            chosen = rest
    return chosen


def travel_order(joints: Array, last: int, chosen: Sequence[int]) -> list[int]:
    """Views of joint angles (V, n), each the nearest to the one before, beginning at the view `last`."""
    out, left, at = list[int](), list(chosen), last
    while left:
        at = min(left, key=lambda k: float(np.abs(joints[k] - joints[at]).sum()))
        left.remove(at)
        out.append(at)
    return out
