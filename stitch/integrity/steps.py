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
from stitch.integrity.step import MOVED_BODIES, MovedBody, PoseStep, likelier_step, step_columns
from stitch.integrity.view_model import ViewModel, projector
from stitch.integrity.view_test import hstack_columns, test_alternative

# That a session without a step shows one. What an arm does wrong where its poses change their kind is a step to a list
# without joint angles: at nine equal poses three of four measured objects show the same one, at p of 0.006 to 0.06.
STEP_CHANCE = 1e-4
# Views from which on all by which poses may err takes minutes to hold against a step.
MAX_VIEWS_WITH_EFFECTS = 100

# Fewer views at an end than this are blunders of their own; more changes than this are no steps but a drift.
_MIN_VIEWS_AT_END, _MAX_STEPS = 2, 3
# Fewer views than this show no step beside their scatter.
_MIN_VIEWS_FOR_STEP = 6
# Less of its columns than this outside the mean is rounding.
_NEW_COLUMN_SHARE = 1e-6


def find_steps(
    model: ViewModel, first: Array | None, singles: tuple[Array | None, int], chance: float
) -> tuple[PoseStep, ...]:
    """Change points in the order of time, beside single views that are off.

    Args:
        model: with all that may happen without a step.
        first: (n, K) columns of views that are known to be off.
        singles: columns (n, K) of these and all single blunders, and how many there are: they may explain as much.
        chance: that a session without a step shows one.
    """
    found, columns = _search_steps(model, first, chance)
    if singles[1]:
        beside_them, every = _search_steps(model, singles[0], chance)
        if not found or _akaike_criterion(model, every) < _akaike_criterion(model, columns):
            found = beside_them
    return tuple(sorted(found, key=lambda s: s.start))


@dataclass(frozen=True)
class _Pick:
    """What explains most beside what was picked before: a step, or a single view that is off."""

    columns: Array  # (n, 6)
    p_value: float
    tests: int  # of which it is the likeliest
    starts: dict[MovedBody, int] | None = None  # where the step of each begins; None: a single view


def _search_steps(model: ViewModel, first: Array | None, chance: float) -> tuple[list[PoseStep], Array | None]:
    """Steps on top of columns that are in the mean already, and all columns with them and with single views.

    As with single views (Rosner 1983) the search goes on beside what does not stand out yet: what is moved there and
    back are two steps, and each hides in the scatter that the other makes, as a step does beside one view far off.
    """
    picked, significant = list[_Pick](), 0
    while (
        model.count >= _MIN_VIEWS_FOR_STEP
        and len(picked) < significant + _MAX_STEPS
        and len(_step_starts(picked)) < _MAX_STEPS
    ):
        pick = _next_pick(model, _with_picked_columns(first, picked), _step_starts(picked))
        if pick is None:
            break
        picked.append(pick)
        p = min(pick.p_value, _joint_p_value(model, first, picked)) if len(picked) > significant + 1 else pick.p_value
        significant = len(picked) if p < chance else significant
    picked = picked[:significant]
    steps = []
    for pick in picked:
        if pick.starts is not None:
            others = _with_picked_columns(first, [other for other in picked if other is not pick])
            steps.append(likelier_step(model, others, pick.starts, _count_step_tests(model)))
    # What was picked early may stand out no more beside the rest.
    return [step for step in steps if step.p_value < chance], _with_picked_columns(first, picked)


def _joint_p_value(model: ViewModel, first: Array | None, picked: Sequence[_Pick]) -> float:
    """Chance of the last two: each may hide in the scatter that the other makes, and then neither stands out alone."""
    *rest, one, other = picked
    columns = _with_picked_columns(first, rest)
    both = test_alternative(
        projector(model, model.fit(columns), columns), np.column_stack([one.columns, other.columns])
    )
    return both.p_value * one.tests * other.tests


def _step_starts(picked: Sequence[_Pick]) -> list[dict[MovedBody, int]]:
    return [pick.starts for pick in picked if pick.starts is not None]


def _with_picked_columns(first: Array | None, picked: Sequence[_Pick]) -> Array | None:
    for pick in picked:
        first = hstack_columns(first, pick.columns)
    return first


def _next_pick(model: ViewModel, columns: Array | None, taken: Sequence[dict[MovedBody, int]]) -> _Pick | None:
    """The likeliest step, or the single view that is off, beside some columns; None where these leave no view."""
    under = projector(model, model.fit(columns), columns)
    starts = [
        k
        for k in range(_MIN_VIEWS_AT_END, model.count - _MIN_VIEWS_AT_END + 1)
        if k not in [k for own in taken for k in own.values()]
    ]
    tests = {
        (moved, k): test_alternative(under, step_columns(model, k, moved)) for moved in MOVED_BODIES for k in starts
    }
    mean = model.mixed(columns).A[0]
    alone = {v: test_alternative(under, own) for v, own in enumerate(model.views) if not _held_by_mean(own, mean)}
    if not alone:
        return None
    view = min(alone, key=lambda v: (alone[v].p_value, -alone[v].statistic))
    likelier = min(tests, key=lambda at: (tests[at].p_value, -tests[at].statistic))
    if (alone[view].p_value, -alone[view].statistic) < (tests[likelier].p_value, -tests[likelier].statistic):
        return _Pick(model.views[view], alone[view].p_value * model.count, model.count)
    best = {moved: max(starts, key=lambda k: tests[moved, k].statistic) for moved in MOVED_BODIES}
    moved, start = likelier
    return _Pick(
        step_columns(model, start, moved),
        tests[likelier].p_value * _count_step_tests(model),
        _count_step_tests(model),
        best,
    )


def _held_by_mean(columns: Array, mean: Array) -> bool:
    """True if columns (n, 6) say nothing that a mean of orthonormal columns (n, K) does not hold."""
    left = columns - mean @ (mean.T @ columns)
    return bool(np.linalg.norm(left) < _NEW_COLUMN_SHARE * np.linalg.norm(columns))


def _count_step_tests(model: ViewModel) -> int:
    """How many steps are tested."""
    return len(MOVED_BODIES) * (model.count - 2 * _MIN_VIEWS_AT_END + 1) * _MAX_STEPS


def _akaike_criterion(model: ViewModel, columns: Array | None) -> float:
    """Akaike's for few numbers (Hurvich and Tsai 1989): half of the views, let go, would leave no scatter."""
    count = len(model.z)
    taken = model.hand_eye.shape[1] + (0 if columns is None else columns.shape[1])
    return model.deviance(columns) + 2 * taken * count / (count - taken - 1) if count > taken + 1 else np.inf
