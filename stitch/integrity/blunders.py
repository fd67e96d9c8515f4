"""Blunders among the poses of the views: how many, which, and whether all from one on moved together.

Single views: generalised extreme Studentised deviate (Rosner 1983, Technometrics 25:165). The most deviant view is let
go, the scatter estimated anew, and so on; the number of blunders is the largest count whose last one is significant,
so that several cannot hide in the scatter which they inflate. What all views from one on have in common is a step
(`steps.py`); beside it single ones are sought anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from stitch.frames import Array
from stitch.integrity.left_alone import leave_one_out_test
from stitch.integrity.step import PoseStep
from stitch.integrity.view_model import Projector, ViewModel, projector
from stitch.integrity.view_test import hstack_columns, test_alternative
from stitch.statistics.variance_components import VarianceFit

# Chance that a session without blunders loses a view.
FAMILY_WISE = 0.01
# At most a third of the views can be blunders: beyond, nothing says which are the good ones.
_MAX_BLUNDER_SHARE = 1 / 3
# Masking shows within a few steps; a search that has found nothing by then ends.
_MASKING_DEPTH = 3
# The most deviant views, tested under the scatter of the others alone.
_LEAVE_ONE_OUT_COUNT = 3


@dataclass(frozen=True)
class Blunder:
    """One view whose pose contradicts the others."""

    view: int
    p_value: float  # family-wise


@dataclass(frozen=True)
class BlunderSearch:
    """What the tests say, and the scatter of the poses without the blunders."""

    blunders: tuple[Blunder, ...]
    fit: VarianceFit
    mean_columns: Array | None  # (n, K) columns of blunders and steps in the mean
    null_projector: Projector  # null hypothesis with those columns in it


def find_blunders(model: ViewModel, excluded: Sequence[int] = (), steps: Sequence[PoseStep] = ()) -> BlunderSearch:
    """Blunders among the views of a model.

    Args:
        excluded: views that are known to be off: they stay free and are not counted.
        steps: what all views from one on have in common.
    """
    return _rosner(model, free_view_columns(model, excluded, steps), excluded)


def find_unlinked_blunders(
    model: ViewModel, excluded: Sequence[int], unlinked: Sequence[int], steps: Sequence[PoseStep] = ()
) -> list[Blunder]:
    """Of views that no surface links where they should stand, those that the scatter of all others does not explain."""
    out = []
    for v in unlinked:
        p = leave_one_out_test(
            model, free_view_columns(model, [*excluded, *(w for w in unlinked if w != v)], steps), v
        )[1]
        p = min(1.0, model.count * p)
        if p < FAMILY_WISE:
            out.append(Blunder(v, p))
    return out


def free_view_columns(model: ViewModel, excluded: Sequence[int], steps: Sequence[PoseStep]) -> Array | None:
    """(n, K) of views that stay free, and of steps."""
    columns = model.columns(excluded)
    for step in steps:
        columns = hstack_columns(columns, step.columns(model))
    return columns


def _rosner(model: ViewModel, first: Array | None, excluded: Sequence[int]) -> BlunderSearch:
    """Single blunders on top of columns that are in the mean already."""
    freed: list[Blunder] = []
    columns, states = first, list[tuple[VarianceFit, Array | None, Projector]]()
    most = max(int(_MAX_BLUNDER_SHARE * model.count) - len(excluded), 0)
    significant = 0
    while True:
        fit = model.fit(columns)
        under = projector(model, fit, columns)
        states.append((fit, columns, under))
        rest = [v for v in range(model.count) if v not in excluded and v not in [b.view for b in freed]]
        if len(freed) >= most or len(freed) >= significant + _MASKING_DEPTH or under.degrees < 12:
            break
        tests = {v: test_alternative(under, model.views[v]) for v in rest}
        likely = sorted(rest, key=lambda v: (tests[v].p_value, -tests[v].statistic))[:_LEAVE_ONE_OUT_COUNT]
        # Either test alone holds its level; together they were seen to stay below it (docs/integrity.md).
        chance = {v: min(tests[v].p_value, leave_one_out_test(model, columns, v)[1]) for v in likely}
        worst = min(likely, key=lambda v: chance[v])
        p = min(1.0, chance[worst] * len(rest))
        freed.append(Blunder(worst, p))
        if p < FAMILY_WISE:
            significant = len(freed)
        columns = hstack_columns(columns, model.views[worst])
    fit, columns, under = states[significant]
    return BlunderSearch(tuple(freed[:significant]), fit, columns, under)
