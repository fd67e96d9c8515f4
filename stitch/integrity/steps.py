"""From which view on the part or the scanner sits elsewhere: clamped anew, knocked, its mount re-seated.

Under one hand-eye for all views every change point in the order of time is tested, for the part and for the scanner,
as a displacement that all views from there on share: Baarda's test as for single views, an F since the scatter comes
from the same data, times the number of tests (Bonferroni). What drifts, warms up, remembers or follows
the pose is no step, so the scatter holds all by which poses of a good session may err, in sizes that these views show.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stitch.frames import Array
from stitch.integrity.view_test import ViewModel, beside, projector, test
from stitch.units import angle_text, length_text

What = Literal["part", "scanner"]

# That a session without a step shows one. What an arm does wrong where its poses change their kind is a step to a list
# without joint angles: at nine equal poses three of four measured objects show the same one, at p of 0.006 to 0.06.
CHANCE = 1e-4
# Views from which on all by which poses may err takes minutes to hold against a step.
MANY_VIEWS = 100

# Fewer views at an end than this are blunders of their own; more changes than this are no steps but a drift.
_SIDE, _MOST = 2, 3
# Fewer views than this show no step beside their scatter.
_FEWEST = 6
_BOTH: tuple[What, What] = ("part", "scanner")
# Less of its columns than this outside the mean is rounding.
_NEW = 1e-6
# −2 log likelihood of part against scanner at odds of 20 to 1; closer ones these views do not tell apart.
_TOLD = 2 * np.log(20)


@dataclass(frozen=True)
class Step:
    """From view `start` on all views share one displacement."""

    start: int
    moved: What
    told: bool  # the other one of the two is clearly less likely
    rotation: float  # rad
    distance: float  # length_unit, of the middle of the part as it is seen
    p_value: float  # all change points counted

    def said(self, names: Sequence[str], length_unit: str) -> str:
        """What happened and what to do, in words."""
        before, after = names[self.start - 1], names[self.start]
        off = f"{length_text(self.distance, length_unit)} and {angle_text(self.rotation, 2)}"
        other = "scanner" if self.moved == "part" else "part"
        unsure = "" if self.told else f" (or the {other}: these views do not tell which)"
        further = ", or add the effect part_slip" if self.moved == "part" and self.told else ""
        return (
            f"From view {after} on the {self.moved} sits elsewhere{unsure}, {off} off at the part: no hand-eye holds "
            f"before and after. Make two sessions of it, one up to {before} and one from {after} on{further}."
        )

    def columns(self, model: ViewModel) -> Array:
        """(n, 6) of the displacement."""
        return step_columns(model, self.start, self.moved)


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
    if singles[1] and (not found or _criterion(model, singles[0]) < _criterion(model, columns)):
        found, _ = _searched(model, singles[0], chance)
    return tuple(sorted(found, key=lambda s: s.start))


def step_columns(model: ViewModel, start: int, moved: str) -> Array:
    """(n, 6) of a displacement that views from `start` on have in common."""
    return np.asarray((model.views if moved == "part" else model.mounts)[start:].sum(axis=0))


@dataclass(frozen=True)
class _Pick:
    """What explains most beside what was picked before: a step, or a single view that is off."""

    columns: Array  # (n, 6)
    p_value: float
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
        significant = len(picked) if picked[-1].p_value < chance else significant
    picked = picked[:significant]
    steps = []
    for pick in picked:
        if pick.starts is not None:
            others = _beside(first, [other for other in picked if other is not pick])
            steps.append(_step(model, others, pick.starts))
    # What was picked early may stand out no more beside the rest.
    return [step for step in steps if step.p_value < chance], _beside(first, picked)


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
    tests = {(moved, k): test(under, step_columns(model, k, moved)) for moved in _BOTH for k in starts}
    mean = model.mixed(columns).A[0]
    alone = {v: test(under, own) for v, own in enumerate(model.views) if not _held(own, mean)}
    if not alone:
        return None
    view = min(alone, key=lambda v: (alone[v].p_value, -alone[v].statistic))
    likelier = min(tests, key=lambda at: (tests[at].p_value, -tests[at].statistic))
    if (alone[view].p_value, -alone[view].statistic) < (tests[likelier].p_value, -tests[likelier].statistic):
        return _Pick(model.views[view], alone[view].p_value * model.count)
    best = {moved: max(starts, key=lambda k: tests[moved, k].statistic) for moved in _BOTH}
    moved, start = likelier
    return _Pick(step_columns(model, start, moved), tests[likelier].p_value * _tests(model), best)


def _held(columns: Array, mean: Array) -> bool:
    """True if columns (n, 6) say nothing that a mean of orthonormal columns (n, K) does not hold."""
    left = columns - mean @ (mean.T @ columns)
    return bool(np.linalg.norm(left) < _NEW * np.linalg.norm(columns))


def _tests(model: ViewModel) -> int:
    """How many steps are tested."""
    return len(_BOTH) * (model.count - 2 * _SIDE + 1) * _MOST


def _step(model: ViewModel, columns: Array | None, best: dict[What, int]) -> Step:
    """The likelier one of the best step of the part and of the scanner, with its size."""
    own = {moved: beside(columns, step_columns(model, best[moved], moved)) for moved in _BOTH}
    deviance = {moved: model.deviance(own[moved]) for moved in _BOTH}
    likelier = min(_BOTH, key=lambda moved: deviance[moved])
    told = bool(abs(deviance["part"] - deviance["scanner"]) > _TOLD)
    start = best[likelier]
    displaced = step_columns(model, start, likelier)
    p = test(projector(model, model.fit(columns), columns), displaced).p_value * _tests(model)
    estimate = test(projector(model, model.fit(own[likelier]), columns), displaced).estimate
    moved = (model.mount_twists[start:] if likelier == "scanner" else np.eye(6)[None]) @ estimate
    turn, shift = (float(np.median(np.linalg.norm(half, axis=1))) for half in (moved[:, :3], moved[:, 3:]))
    return Step(start, likelier, told, turn / model.lever, shift, p)


def _criterion(model: ViewModel, columns: Array | None) -> float:
    """Akaike's for few numbers (Hurvich and Tsai 1989): half of the views, let go, would leave no scatter."""
    count = len(model.z)
    taken = model.hand_eye.shape[1] + (0 if columns is None else columns.shape[1])
    return model.deviance(columns) + 2 * taken * count / (count - taken - 1) if count > taken + 1 else np.inf
