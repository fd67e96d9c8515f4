"""Blunders among the poses of the views: how many, which, and whether all from one on moved together.

Single views: generalised extreme Studentised deviate (Rosner 1983, Technometrics 25:165). The most deviant view is let
go, the scatter estimated anew, and so on; the number of blunders is the largest count whose last one is significant,
so that several cannot hide in the scatter which they inflate. What all views from one on have in common is a step
(`steps.py`); beside it single ones are sought anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from stitch.frames import Array
from stitch.integrity.left_alone import left_alone
from stitch.integrity.step import Step
from stitch.integrity.view_model import Projector, ViewModel, projector
from stitch.integrity.view_test import beside, test
from stitch.statistics.variance_components import VarianceFit

# Chance that a session without blunders loses a view.
FAMILY_WISE = 0.01
# At most a third of the views can be blunders: beyond, nothing says which are the good ones.
_MOST = 1 / 3
# Masking shows within a few steps; a search that has found nothing by then ends.
_LOOKED_AT = 3
# The most deviant views, tested under the scatter of the others alone.
_LEFT_ALONE = 3


@dataclass(frozen=True)
class Blunder:
    """One view whose pose contradicts the others."""

    view: int
    p_value: float  # family-wise


@dataclass(frozen=True)
class Found:
    """What the tests say, and the scatter of the poses without the blunders."""

    blunders: tuple[Blunder, ...]
    fit: VarianceFit
    further: Array | None  # (n, K) columns of blunders and steps in the mean
    under: Projector  # null hypothesis with those columns in it


def find_blunders(model: ViewModel, alone: Sequence[int] = (), steps: Sequence[Step] = ()) -> Found:
    """Blunders among the views of a model.

    Args:
        alone: views that are known to be off: they stay free and are not counted.
        steps: what all views from one on have in common.
    """
    return _rosner(model, columns_of(model, alone, steps), alone)


def off_anyway(
    model: ViewModel, alone: Sequence[int], unlinked: Sequence[int], steps: Sequence[Step] = ()
) -> list[Blunder]:
    """Of views that no surface links where they should stand, those that the scatter of all others does not explain."""
    out = []
    for v in unlinked:
        p = left_alone(model, columns_of(model, [*alone, *(w for w in unlinked if w != v)], steps), v)[1]
        p = min(1.0, model.count * p)
        if p < FAMILY_WISE:
            out.append(Blunder(v, p))
    return out


def columns_of(model: ViewModel, alone: Sequence[int], steps: Sequence[Step]) -> Array | None:
    """(n, K) of views that stay free, and of steps."""
    columns = model.columns(alone)
    for step in steps:
        columns = beside(columns, step.columns(model))
    return columns


def _rosner(model: ViewModel, first: Array | None, alone: Sequence[int]) -> Found:
    """Single blunders on top of columns that are in the mean already."""
    freed: list[Blunder] = []
    columns, states = first, list[tuple[VarianceFit, Array | None, Projector]]()
    most = max(int(_MOST * model.count) - len(alone), 0)
    significant = 0
    while True:
        fit = model.fit(columns)
        under = projector(model, fit, columns)
        states.append((fit, columns, under))
        rest = [v for v in range(model.count) if v not in alone and v not in [b.view for b in freed]]
        if len(freed) >= most or len(freed) >= significant + _LOOKED_AT or under.degrees < 12:
            break
        tests = {v: test(under, model.views[v]) for v in rest}
        likely = sorted(rest, key=lambda v: (tests[v].p_value, -tests[v].statistic))[:_LEFT_ALONE]
        # Either test alone holds its level; together they were seen to stay below it (docs/integrity.md).
        chance = {v: min(tests[v].p_value, left_alone(model, columns, v)[1]) for v in likely}
        worst = min(likely, key=lambda v: chance[v])
        p = min(1.0, chance[worst] * len(rest))
        freed.append(Blunder(worst, p))
        if p < FAMILY_WISE:
            significant = len(freed)
        columns = beside(columns, model.views[worst])
    fit, columns, under = states[significant]
    return Found(tuple(freed[:significant]), fit, columns, under)
