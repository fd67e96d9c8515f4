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
    """Change points in the order of time.

    Args:
        model: with all that may happen without a step.
        first: (n, K) columns of views that are known to be off.
        singles: columns (n, K) of these and all single blunders, and how many there are: they may explain as much.
        chance: that a session without a step shows one.
    """
    found = _searched(model, first, chance)
    if singles[1] and (not found or _less_likely(model, found, first, singles)):
        first = singles[0]
        found = _searched(model, first, chance)
    return tuple(sorted(found, key=lambda s: s.start))


def step_columns(model: ViewModel, start: int, moved: str) -> Array:
    """(n, 6) of a displacement that views from `start` on have in common."""
    return np.asarray((model.views if moved == "part" else model.mounts)[start:].sum(axis=0))


def _searched(model: ViewModel, first: Array | None, chance: float) -> list[Step]:
    """Steps on top of columns that are in the mean already.

    As with single views (Rosner 1983) the search goes on beside a step that does not stand out yet: what is moved there
    and back are two, and each hides in the scatter that the other makes.
    """
    if model.count < _FEWEST:
        return []
    picked, significant, columns = list[tuple[dict[What, int], What, float]](), 0, first
    while len(picked) < _MOST:
        best, moved, p = _next_step(model, columns, [own[other] for own, other, _ in picked])
        picked.append((best, moved, p))
        significant = len(picked) if p < chance else significant
        columns = beside(columns, step_columns(model, best[moved], moved))
    out = []
    for best, _, p in picked[:significant]:
        others = first
        for own, other, _ in picked[:significant]:
            others = others if own is best else beside(others, step_columns(model, own[other], other))
        out.append(_step(model, others, best, min(p, picked[significant - 1][2])))
    return out


def _next_step(model: ViewModel, columns: Array | None, taken: Sequence[int]) -> tuple[dict[What, int], What, float]:
    """Where the likeliest step of each begins beside some columns, which of the two is likelier, and its chance."""
    under = projector(model, model.fit(columns), columns)
    starts = [k for k in range(_SIDE, model.count - _SIDE + 1) if k not in taken]
    tests = {(moved, k): test(under, step_columns(model, k, moved)) for moved in _BOTH for k in starts}
    best = {moved: max(starts, key=lambda k: tests[moved, k].statistic) for moved in _BOTH}
    likelier = max(_BOTH, key=lambda moved: tests[moved, best[moved]].statistic)
    return best, likelier, min(found.p_value for found in tests.values()) * len(tests) * _MOST


def _step(model: ViewModel, columns: Array | None, best: dict[What, int], p: float) -> Step:
    """The likelier one of the best step of the part and of the scanner, with its size."""
    own = {moved: beside(columns, step_columns(model, best[moved], moved)) for moved in _BOTH}
    deviance = {moved: model.deviance(own[moved]) for moved in _BOTH}
    likelier = min(_BOTH, key=lambda moved: deviance[moved])
    told = bool(abs(deviance["part"] - deviance["scanner"]) > _TOLD)
    start = best[likelier]
    under = projector(model, model.fit(own[likelier]), columns)
    estimate = test(under, step_columns(model, start, likelier)).estimate
    moved = (model.mount_twists[start:] if likelier == "scanner" else np.eye(6)[None]) @ estimate
    turn, shift = (float(np.median(np.linalg.norm(half, axis=1))) for half in (moved[:, :3], moved[:, 3:]))
    return Step(start, likelier, told, turn / model.lever, shift, p)


def _less_likely(
    model: ViewModel, found: Sequence[Step], first: Array | None, singles: tuple[Array | None, int]
) -> bool:
    """True if single blunders explain more: by Akaike's rule each number that they take must earn two."""
    columns, count = singles
    for step in found:
        first = beside(first, step.columns(model))
    return model.deviance(columns) + 12 * (count - len(found)) < model.deviance(first)
