"""From which view on the part or the scanner sits elsewhere: clamped anew, knocked, its mount re-seated.

Under one hand-eye for all views every change point in the order of time is tested, for the part and for the scanner,
as a displacement that all views from there on share: Baarda's test as for single views, an F since the scatter comes
from the same data, times the number of tests (Bonferroni). What drifts, warms up, remembers or follows
the pose is no step, so the scatter holds all by which poses of a good session may err, in sizes that these views show.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.integrity.step import BOTH, Step, What, likelier_step, step_columns
from stitch.integrity.view_model import ViewModel, projector
from stitch.integrity.view_test import beside, test

# That a session without a step shows one. What an arm does wrong where its poses change their kind is a step to a list
# without joint angles: at nine equal poses three of four measured objects show the same one, at p of 0.006 to 0.06.
CHANCE = 1e-4
# Views from which on all by which poses may err takes minutes to hold against a step.
MANY_VIEWS = 100

# Fewer views at an end than this are blunders of their own; more changes than this are no steps but a drift.
_SIDE, _MOST = 2, 3
# Fewer views than this show no step beside their scatter.
_FEWEST = 6
# Less of its columns than this outside the mean is rounding.
_NEW = 1e-6


def find_steps(
    model: ViewModel, first: Array | None, singles: tuple[Array | None, int], chance: float
) -> tuple[Step, ...]:
    """Change points in the order of time, beside single views that are off.

    Args:
        model: with all that may happen without a step.
        first: (n, K) columns of views that are known to be off.
        singles: columns (n, K) of these and all single blunders, and how many there are: they may explain as much.
        chance: that a session without a step shows one.
    """
    found, columns = _searched(model, first, chance)
    if singles[1]:
        beside_them, every = _searched(model, singles[0], chance)
        if not found or _criterion(model, every) < _criterion(model, columns):
            found = beside_them
    return tuple(sorted(found, key=lambda s: s.start))


@dataclass(frozen=True)
class _Pick:
    """What explains most beside what was picked before: a step, or a single view that is off."""

    columns: Array  # (n, 6)
    p_value: float
    tests: int  # of which it is the likeliest
    starts: dict[What, int] | None = None  # where the step of each begins; None: a single view


def _searched(model: ViewModel, first: Array | None, chance: float) -> tuple[list[Step], Array | None]:
    """Steps on top of columns that are in the mean already, and all columns with them and with single views.

    As with single views (Rosner 1983) the search goes on beside what does not stand out yet: what is moved there and
    back are two steps, and each hides in the scatter that the other makes, as a step does beside one view far off.
    """
    picked, significant = list[_Pick](), 0
    while model.count >= _FEWEST and len(picked) < significant + _MOST and len(_starts(picked)) < _MOST:
        pick = _next(model, _beside(first, picked), _starts(picked))
        if pick is None:
            break
        picked.append(pick)
        p = min(pick.p_value, _together(model, first, picked)) if len(picked) > significant + 1 else pick.p_value
        significant = len(picked) if p < chance else significant
    picked = picked[:significant]
    steps = []
    for pick in picked:
        if pick.starts is not None:
            others = _beside(first, [other for other in picked if other is not pick])
            steps.append(likelier_step(model, others, pick.starts, _tests(model)))
    # What was picked early may stand out no more beside the rest.
    return [step for step in steps if step.p_value < chance], _beside(first, picked)


def _together(model: ViewModel, first: Array | None, picked: Sequence[_Pick]) -> float:
    """Chance of the last two: each may hide in the scatter that the other makes, and then neither stands out alone."""
    *rest, one, other = picked
    columns = _beside(first, rest)
    both = test(projector(model, model.fit(columns), columns), np.column_stack([one.columns, other.columns]))
    return both.p_value * one.tests * other.tests


def _starts(picked: Sequence[_Pick]) -> list[dict[What, int]]:
    return [pick.starts for pick in picked if pick.starts is not None]


def _beside(first: Array | None, picked: Sequence[_Pick]) -> Array | None:
    for pick in picked:
        first = beside(first, pick.columns)
    return first


def _next(model: ViewModel, columns: Array | None, taken: Sequence[dict[What, int]]) -> _Pick | None:
    """The likeliest step, or the single view that is off, beside some columns; None where these leave no view."""
    under = projector(model, model.fit(columns), columns)
    starts = [k for k in range(_SIDE, model.count - _SIDE + 1) if k not in [k for own in taken for k in own.values()]]
    tests = {(moved, k): test(under, step_columns(model, k, moved)) for moved in BOTH for k in starts}
    mean = model.mixed(columns).A[0]
    alone = {v: test(under, own) for v, own in enumerate(model.views) if not _held(own, mean)}
    if not alone:
        return None
    view = min(alone, key=lambda v: (alone[v].p_value, -alone[v].statistic))
    likelier = min(tests, key=lambda at: (tests[at].p_value, -tests[at].statistic))
    if (alone[view].p_value, -alone[view].statistic) < (tests[likelier].p_value, -tests[likelier].statistic):
        return _Pick(model.views[view], alone[view].p_value * model.count, model.count)
    best = {moved: max(starts, key=lambda k: tests[moved, k].statistic) for moved in BOTH}
    moved, start = likelier
    return _Pick(step_columns(model, start, moved), tests[likelier].p_value * _tests(model), _tests(model), best)


def _held(columns: Array, mean: Array) -> bool:
    """True if columns (n, 6) say nothing that a mean of orthonormal columns (n, K) does not hold."""
    left = columns - mean @ (mean.T @ columns)
    return bool(np.linalg.norm(left) < _NEW * np.linalg.norm(columns))


def _tests(model: ViewModel) -> int:
    """How many steps are tested."""
    return len(BOTH) * (model.count - 2 * _SIDE + 1) * _MOST


def _criterion(model: ViewModel, columns: Array | None) -> float:
    """Akaike's for few numbers (Hurvich and Tsai 1989): half of the views, let go, would leave no scatter."""
    count = len(model.z)
    taken = model.hand_eye.shape[1] + (0 if columns is None else columns.shape[1])
    return model.deviance(columns) + 2 * taken * count / (count - taken - 1) if count > taken + 1 else np.inf
