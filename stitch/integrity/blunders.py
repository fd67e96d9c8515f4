"""Blunders among the poses of the views: how many, which, and whether a whole block moved together.

Single views: generalised extreme Studentised deviate (Rosner 1983, Technometrics 25:165). The most deviant view is let
go, the scatter estimated anew, and so on; the number of blunders is the largest count whose last one is significant,
so that several cannot hide in the scatter which they inflate. A block from view k on with one displacement in common
(the part re-clamped, or the scanner moved) is told from single ones and from a slow drift by likelihood.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.integrity.left_alone import left_alone
from stitch.integrity.view_test import Projector, Test, ViewModel, beside, projector, test
from stitch.statistics.variance_components import VarianceFit

# Chance that a session without blunders loses a view.
FAMILY_WISE = 0.01
# At most a third of the views can be blunders: beyond, nothing says which are the good ones.
_MOST = 1 / 3
# Masking shows within a few steps; a search that has found nothing by then ends.
_LOOKED_AT = 3
# The most deviant views, tested under the scatter of the others alone.
_LEFT_ALONE = 3
# A step in time must explain this much more (−2 log likelihood) than a drift or single views do, per number it takes.
_CLEARER = 10.0
# … and the scatter without it must be this much smaller: a re-clamped part moves by more than poses scatter.
_STEP_RATIO = 3.0


@dataclass(frozen=True)
class Blunder:
    """One view whose pose contradicts the others."""

    view: int
    test: Test
    p_value: float  # family-wise


@dataclass(frozen=True)
class Block:
    """From view `start` on all poses share one displacement."""

    start: int
    what: str  # part | scanner
    estimate: Array  # (6,) of the part: left twist about the centre, rotations in 1/lever; of the scanner: rad, length
    p_value: float


@dataclass(frozen=True)
class Found:
    """What the tests say, and the scatter of the poses without the blunders."""

    blunders: tuple[Blunder, ...]
    block: Block | None
    fit: VarianceFit
    further: Array | None  # (n, K) columns of blunders and block in the mean
    under: Projector  # null hypothesis with those columns in it


def find_blunders(model: ViewModel, alone: Sequence[int] = ()) -> Found:
    """Blunders among the views of a model.

    Args:
        alone: views that are known to be off: they stay free and are not counted.
    """
    first = model.columns(list(alone))
    plain = _rosner(model, first, alone)
    block = _block(model, first, plain)
    if block is None:
        return plain
    columns = beside(first, _block_columns(model, block.start, block.what))
    with_block = _rosner(model, columns, alone)
    return Found(with_block.blunders, block, with_block.fit, with_block.further, with_block.under)


def off_anyway(model: ViewModel, alone: Sequence[int], unlinked: Sequence[int]) -> list[Blunder]:
    """Of views that no surface links where they should stand, those that the scatter of all others does not explain."""
    out = []
    for v in unlinked:
        beside = model.columns([*alone, *(w for w in unlinked if w != v)])
        tested, p = left_alone(model, beside, v)
        p = min(1.0, model.count * p)
        if p < FAMILY_WISE:
            out.append(Blunder(v, tested, p))
    return out


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
        freed.append(Blunder(worst, tests[worst], p))
        if p < FAMILY_WISE:
            significant = len(freed)
        columns = beside(columns, model.views[worst])
    fit, columns, under = states[significant]
    return Found(tuple(freed[:significant]), None, fit, columns, under)


def _block(model: ViewModel, first: Array | None, plain: Found) -> Block | None:
    """The step in time that explains more than single blunders and more than a drift; None if none does."""
    views = model.count
    if views < 6:
        return None
    start = model.fit(first)
    under = projector(model, start, first)
    tried = {
        (k, what): test(under, _block_columns(model, k, what))
        for k in range(2, views - 1)
        for what in ("part", "scanner")
    }
    k, what = max(tried, key=lambda key: tried[key].statistic)
    both = [_likelihood(model, beside(first, _block_columns(model, k, w))) for w in ("part", "scanner")]
    what = "part" if both[0][0] <= both[1][0] else "scanner"
    deviance, fit = both[0 if what == "part" else 1]
    drift = min(_likelihood(model, beside(first, c))[0] for c in _drifts(model))
    singles, _ = _likelihood(model, plain.further)
    # Every single blunder takes six numbers of its own: by Akaike's rule each must earn two.
    alone = singles + 12 * max(len(plain.blunders) - 1, 0)
    clearer = deviance + _CLEARER < min(drift, alone)
    smaller = np.sqrt(np.max(start.variances[:2] / np.maximum(fit.variances[:2], 1e-300))) > _STEP_RATIO
    if not (clearer and smaller):
        return None
    columns = _block_columns(model, k, what)
    found = test(projector(model, fit, first), columns)
    p = min(1.0, found.p_value * 2 * (views - 3))
    return Block(k, what, found.estimate, p) if p < FAMILY_WISE else None


def _likelihood(model: ViewModel, columns: Array | None) -> tuple[float, VarianceFit]:
    """−2 log of the full likelihood of z (comparable between means), and the fit."""
    fit = model.fit(columns)
    mixed = model.mixed(columns)
    C = mixed.covariance(fit.variances)[0]
    under = projector(model, fit, columns)
    return float(np.linalg.slogdet(C)[1] + model.z @ under.pushed), fit


def _block_columns(model: ViewModel, start: int, what: str) -> Array:
    """(n, 6) of a displacement that views from `start` on have in common."""
    return np.asarray((model.views if what == "part" else model.mounts)[start:].sum(axis=0))


def _drifts(model: ViewModel) -> list[Array]:
    """(n, 6) each: part or scanner moves in proportion to the number of the view."""
    order = np.linspace(-1, 1, model.count)[:, None, None]
    return [np.asarray((order * columns).sum(axis=0)) for columns in (model.views, model.mounts)]
