"""Sparse regression over a dictionary: chosen in one half of the views, tested in the other.

In one half ingredients are added greedily (orthogonal matching pursuit), after the first as long as the next one
explains more than the best of all of them would by chance. The other half, which took no part in that, then says if the
same sum of ingredients is wanted there: a test beside everything else that poses may err by, and how much likelier its
numbers are with the sizes that the first half found. Halves change roles, and all ways are counted.

What follows the arm is asked for in views taken alternately. What follows time, or what moves with time, in the first
and the second half of the session too, and always beside errors that wander as much as all views show: these look the
same in views that are neighbours in time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.validation.halves import explained_beside
from stitch.explanation.pursuit import sums_of
from stitch.frames import Array, Indices, Mask
from stitch.measurement.scan import evenly
from stitch.observations.flange_errors import WANDERING
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import Surfaces
from stitch.statistics.least_squares import column_space
from stitch.statistics.tails import chi2_tail
from stitch.statistics.variance_components import at_variances
from stitch.statistics.variance_prior import NOISE

_FIRST, _TESTED = 8, 3  # addends with which a sum is begun; sums of a half that are tested in the other
_REJECTED = 0.01
_ENOUGH = 300  # views of a half
_BLOCKS = 16  # of neighbours in time, for views that share a wandering error which no prior knows
# A prior of this many sizes as they come out keeps what a half does not see finite.
_WIDE = 10.0
_FAINT = 1e-6


@dataclass(frozen=True)
class Chosen:
    """Ingredients by their number in the dictionary, and how they stood the test."""

    numbers: tuple[int, ...]
    p_value: float  # in the half that took no part in choosing, all ways counted
    log_bayes_factor: float  # of that half's numbers with the sizes of the other over none
    both: float  # the same, with that of the other half's numbers with the sizes of this one

    @property
    def holds(self) -> bool:
        """True if the half that took no part wants it."""
        return self.p_value < _REJECTED and self.log_bayes_factor > ODDS


def search(
    linear: LinearModel, responses: Array, addends: Sequence[tuple[int, ...]], places: Sequence[str], slow: Mask
) -> Chosen | None:
    """The sum of addends at one place that explains most and stands its test best; None where no half suggests any.

    Args:
        responses: (·, M) of the observation to the ingredients.
        addends: numbers of the ingredients that come together, all of one place, all slow or none.
        places: of the M ingredients.
        slow: (M,) what follows time or what moves with it: views near in time share it, and wandering errors too.
    """
    columns, found = linear.reduce(responses), list[Chosen]()
    alternate = [_some(half) for half in _alternate(linear)]
    early_late = [_some(half) for half in np.array_split(np.arange(_views(linear)), 2)]
    ways = 0
    for place, among in sorted({(places[own[0]], bool(slow[own[0]])) for own in addends}):
        some = [own for own in addends if (places[own[0]], bool(slow[own[0]])) == (place, among)]
        for halves in (alternate, early_late) if among else (alternate,):
            for way in (halves, halves[::-1]):
                found += _one_way(linear, columns, some, among, way[0], way[1])
                ways += 1
    found = [replace(c, p_value=min(1.0, ways * c.p_value)) for c in found]
    # Of sums that hold the one that is likeliest in both halves: each was chosen in one of them.
    return max(found, key=lambda c: (c.holds, c.both)) if found else None


def _views(linear: LinearModel) -> int:
    return linear.measurement.views.count


def _alternate(linear: LinearModel) -> list[Indices]:
    """Two halves over the same region of poses: view by view, or in blocks of time."""
    blocks = _views(linear) if isinstance(linear.observation, Surfaces) else min(_BLOCKS, _views(linear))
    block = np.arange(_views(linear)) * blocks // _views(linear)
    return [np.flatnonzero(block % 2 == k) for k in (0, 1)]


def _some(half: Indices) -> Indices:
    """Views of a half, evenly over it: more of thousands would tell nothing new, and their columns fill the memory."""
    return half if len(half) <= _ENOUGH else half[evenly(len(half), _ENOUGH)]


def _one_way(
    linear: LinearModel,
    columns: Array,
    addends: Sequence[tuple[int, ...]],
    slow: bool,
    chosen_in: Indices,
    tested_in: Indices,
) -> list[Chosen]:
    """What a half suggests, begun with each of its best addends, and how it stands the test in the other."""
    every = np.concatenate([np.array(own, np.int64) for own in addends])
    among = columns[:, every]
    seen, z, free = _of_half(linear.scatter_only, among, chosen_in, tested_in)
    ends = np.cumsum([len(own) for own in addends])
    at_once = [tuple(range(end - len(own), end)) for own, end in zip(addends, ends, strict=True)]
    suggested = sorted(sums_of(seen, z, free, at_once, _FIRST))
    own_numbers = [tuple(int(k) for k in every[list(sum_)]) for sum_ in suggested]
    # What is worth nothing under the present scatter is not worth a search for the scatter beside it.
    halves = [_of_half(linear, among, *way)[:2] for way in ((chosen_in, tested_in), (tested_in, chosen_in))]
    worth = [_judged(sum_, *((X[:, sum_], y) for X, y in halves)).log_bayes_factor for sum_ in suggested]
    likely = [own_numbers[k] for k in np.argsort(-np.array(worth), kind="stable")[:_TESTED]]
    tested = [_tested(linear, columns, numbers, slow, chosen_in, tested_in) for numbers in likely]
    return [replace(c, p_value=min(1.0, len(suggested) * c.p_value)) for c in tested]


def _tested(
    linear: LinearModel, columns: Array, numbers: tuple[int, ...], slow: bool, chosen_in: Indices, tested_in: Indices
) -> Chosen:
    """The columns of a sum in the half that took no part in choosing them, under the scatter beside it."""
    own = columns[:, numbers]
    seen, z, _ = _of_half(linear.scatter_only, own, chosen_in, tested_in)
    sizes = _WIDE * np.abs(np.linalg.lstsq(seen, z, rcond=None)[0]) + _FAINT
    base = _scatter_beside(linear, own, sizes, slow)
    ways = (chosen_in, tested_in), (tested_in, chosen_in)
    return _judged(numbers, *(_of_half(base, own, *way)[:2] for way in ways))


def _judged(numbers: tuple[int, ...], chosen: tuple[Array, Array], tested: tuple[Array, Array]) -> Chosen:
    """A sum by its columns and the numbers of either half, in units of the scatter."""
    (A, y), (B, w) = chosen, tested
    told = np.linalg.pinv(B.T @ B, rcond=1e-12, hermitian=True)
    square = float((B.T @ w) @ told @ (B.T @ w))
    factor = _predicted(A, y, B, w)
    return Chosen(numbers, chi2_tail(square, len(numbers)), factor, factor + _predicted(B, w, A, y))


def _scatter_beside(linear: LinearModel, own: Array, sizes: Array, slow: bool) -> LinearModel:
    """Under the scatter that is left beside a sum: what it explains is no scatter. What wanders in time stays."""
    if slow and linear.pose_errors is None:
        return linear
    variances = linear.conditioned_on(own, sizes).null.variances.copy()
    if slow and linear.pose_errors is not None:
        wanders = NOISE + 1 + np.flatnonzero(np.isin(linear.pose_errors.names, list(WANDERING)))
        variances[wanders] = np.maximum(variances, linear.null.variances)[wanders]
    return replace(linear, null=at_variances(linear.mixed, variances))


def _of_half(base: LinearModel, columns: Array, keep: Indices, out: Indices) -> tuple[Array, Array, int]:
    """Whitened columns (n, k) and numbers (n,) of some views, without what the model explains there, and how many of
    the numbers are free."""
    if isinstance(base.observation, Surfaces):
        white, z, U = base.whiten(columns), base.white_z, explained_beside(base, base.observation, out)
    else:
        rows = base.mixed.z.shape[1]
        at = (keep[:, None] * rows + np.arange(rows)).ravel()
        white, z, U = base.whiten(columns, keep), base.white_z[at], column_space(base.white_design[at])
    return white - U @ (U.T @ white), z - U @ (U.T @ z), len(z) - U.shape[1]


def _predicted(A: Array, y: Array, B: Array, w: Array) -> float:
    """Log likelihood ratio of w = B·x for what y = A·x tells of x, over none."""
    mean = np.asarray(np.linalg.lstsq(A, y, rcond=None)[0], float)
    precision = A.T @ A + np.diag((_WIDE * np.abs(mean) + _FAINT) ** -2.0)
    information, vector = B.T @ B, B.T @ w
    both = precision + information
    pull = vector + precision @ mean
    square = pull @ np.linalg.solve(both, pull) - mean @ precision @ mean
    return float(0.5 * square - 0.5 * (np.linalg.slogdet(both)[1] - np.linalg.slogdet(precision)[1]))


def fitted(linear: LinearModel, columns: Array, numbers: Sequence[int]) -> Array:
    """(k,) coefficients of some columns (·, M) from all views, under the scatter that they leave."""
    own = linear.reduce(columns[:, list(numbers)])
    sizes = np.full(len(numbers), 1.0)
    beside = linear.conditioned_on(own, sizes)
    base = replace(linear, null=at_variances(linear.mixed, beside.null.variances))
    return np.asarray(np.linalg.lstsq(base.residual(own), base.white_residual, rcond=None)[0])
