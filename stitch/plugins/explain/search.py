"""Sparse regression over a dictionary: chosen in some of the views, tested in the others.

In some of the views ingredients are added greedily (orthogonal matching pursuit), after the first as long as the next
one explains more than the best of all of them would by chance, and places, widths and periods are moved to where they
explain most. The others, which took no part in that, then say if the same sum of ingredients is wanted there. Halves
and thirds change roles, and all ways are counted. Where one holds, all views say which sum it is.

What follows the arm is asked for in views taken alternately. What follows time, or what moves with time, in the first
and the second half of the session too, and always beside errors that wander as much as all views show: these look the
same in views that are neighbours in time.

A sum is tested beside all that poses may err by, under the scatter that is left once it is taken out: by χ², and by how
much likelier the numbers of that half are with the sizes that the first half found (a partial Bayes factor; Berger &
Pericchi 1996, J. Am. Stat. Assoc. 91:109).
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.thresholds import CONFIRMED_FORMULA, ODDS
from stitch.numerics.distributions import chi2_tail
from stitch.numerics.frames import Array, Indices
from stitch.numerics.parameter_selection import log_evidence
from stitch.numerics.reml import NOISE, at_variances
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import DRIFT_MEMORY
from stitch.plugins.explain.dictionary import Dictionary, Ingredient, group_addends
from stitch.plugins.explain.half_model import HalfModel, sum_residual
from stitch.plugins.explain.pursuit import pursue_sums, quantities_of, refine_parameters, round_parameters
from stitch.session.scan import even_indices

# A prior of this many sizes as they come out keeps what a half does not see finite.
_PRIOR_WIDTH = 10.0
_MIN_PRIOR_SIGMA = 1e-6
_STARTS = 8  # addends with which a sum is begun
_TESTED_SUMS = 3  # sums of some views, or of all, that are tested further
_REPORTED_SUMS = 6  # the likeliest
_ENOUGH_VIEWS = 300  # of a half
_TIME_BLOCKS = 16  # of neighbours in time, for views that share a wandering error which no prior knows


@dataclass(frozen=True)
class TestedSum:
    """A sum of ingredients, and how it stood the test."""

    ingredients: tuple[Ingredient, ...]
    p_value: float  # in the half that took no part in choosing, all ways counted
    log_bayes_factor: float  # of that half's numbers with the sizes of the other over none
    both: float  # the same, with that of the other half's numbers with the sizes of this one
    instead_of: tuple[Ingredient, ...] = ()  # the sum that stood the test, where all views want another in its place

    @property
    def holds(self) -> bool:
        """True if the half that took no part wants it."""
        return self.p_value < CONFIRMED_FORMULA and self.log_bayes_factor > ODDS


def enough_views(linear: LinearModel, terms: Dictionary) -> bool:
    """True if some of the views may choose a sum, and others test it."""
    return next(_half_models(linear, terms, slow=True), None) is not None


def search_sums(linear: LinearModel, terms: Dictionary) -> list[TestedSum]:
    """Return sums of ingredients at one place: those that hold first, the likeliest of them before the others.

    Places, widths and periods are as all views want them. Where a sum holds, those that all views suggest in its place
    come before it.
    """
    groups = defaultdict[tuple[str, bool], list[Ingredient]](list)
    for ingredient in terms.ingredients:
        groups[_group_of(ingredient)].append(ingredient)
    sums = list[TestedSum]()
    ways = 0
    for (_, slow), ingredients in sorted(groups.items(), key=lambda group: group[0]):
        for chosen, other in _half_models(linear, terms, slow):
            sums += _search_split(linear, terms, ingredients, chosen, other)
            ways += 1
    sums = [replace(tested, p_value=min(1.0, ways * tested.p_value)) for tested in sums]
    # Each was chosen in some views: what they and the others say of it counts.
    sums.sort(key=lambda tested: (not tested.holds, -tested.both))
    every = _thinned_views(np.arange(linear.measurement.views.count), 2)
    whole = HalfModel(linear.restricted(()), terms, every)
    reported = [
        replace(tested, ingredients=round_parameters(refine_parameters(tested.ingredients, whole)))
        for tested in sums[:_REPORTED_SUMS]
    ]
    if not sums or not sums[0].holds:
        return reported
    alternatives = groups[_group_of(sums[0].ingredients[0])]
    return [*_sums_of_all_views(linear, terms, alternatives, sums[0], every), *reported]


def fitted_sizes(linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient]) -> Array:
    """Return the sizes (k,) of scaled columns from all views, under the scatter that they leave."""
    refitted = _with_refitted_scatter(linear, terms, ingredients)
    columns = linear.reduce(terms.columns(ingredients))
    return np.asarray(np.linalg.lstsq(refitted.residual(columns), refitted.white_residual, rcond=None)[0], float)


def _group_of(ingredient: Ingredient) -> tuple[str, bool]:
    """Return what ingredients that may stand in one sum have in common."""
    return ingredient.place, ingredient.quantity.slow


def _half_models(linear: LinearModel, terms: Dictionary, slow: bool) -> Iterator[tuple[HalfModel, HalfModel]]:
    """Yield views in which a sum is chosen and those in which it is tested, where either may say something of one."""
    for chosen_views, other_views in _view_splits(linear, slow):
        chosen = HalfModel(linear.restricted(()), terms, chosen_views)
        other = HalfModel(linear.restricted(()), terms, other_views)
        if chosen.has_room() and other.has_room():
            yield chosen, other


def _view_splits(linear: LinearModel, slow: bool) -> list[tuple[Indices, Indices]]:
    """Return the views in which a sum is chosen, and those in which it is tested, for each way to split them."""
    # Over the same region of poses: view by view, or in blocks of time.
    count = linear.measurement.views.count
    blocks = count if linear.observation.numbers_per_view is None else min(_TIME_BLOCKS, count)
    block = np.arange(count) * blocks // count
    partitions = [[np.flatnonzero(block % n == k) for k in range(n)] for n in (2, 3)]
    partitions += [np.array_split(np.arange(count), 2)] if slow else []
    return [
        (_thinned_views(np.sort(np.concatenate([*parts[:k], *parts[k + 1 :]]))), _thinned_views(part))
        for parts in partitions
        for k, part in enumerate(parts)
        if len(part)
    ]


def _thinned_views(views: Indices, halves: int = 1) -> Indices:
    """Return views evenly chosen: more of thousands would tell nothing new, and their columns fill the memory."""
    enough = halves * _ENOUGH_VIEWS
    return views if len(views) <= enough else views[even_indices(len(views), enough)]


def _search_split(
    linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient], chosen: HalfModel, other: HalfModel
) -> list[TestedSum]:
    """Find what a half suggests, begun with each of its best addends, and test it in the other."""
    suggested = [
        addends
        for addends in _suggested_sums(chosen, ingredients)
        if chosen.has_room(len(addends)) and other.has_room(len(addends))
    ]
    # What is worth nothing under the present scatter is not worth a search for the scatter beside it.
    worth = [
        _test_sum(addends, (chosen.columns(addends), chosen.z), (other.columns(addends), other.z)).log_bayes_factor
        for addends in suggested
    ]
    likely = [suggested[k] for k in np.argsort(-np.array(worth), kind="stable")[:_TESTED_SUMS]]
    tested = [_test_beside_scatter(linear, terms, addends, (chosen.views, other.views)) for addends in likely]
    return [replace(held, p_value=min(1.0, len(suggested) * held.p_value)) for held in tested]


def _suggested_sums(half: HalfModel, ingredients: Sequence[Ingredient]) -> list[tuple[Ingredient, ...]]:
    """Return sums that explain some views, as these want their places, widths and periods."""
    refined = dict[tuple[int, ...], tuple[Ingredient, ...]]()

    def columns(numbers: tuple[int, ...]) -> Array:
        if numbers not in refined:
            refined[numbers] = refine_parameters([ingredients[k] for k in numbers], half)
        return half.columns(refined[numbers])

    sums = pursue_sums(half.columns(ingredients), half.z, half.free, group_addends(ingredients), _STARTS, columns)
    for numbers in sums - refined.keys():
        columns(numbers)
    return [refined[numbers] for numbers in sorted(sums)]


def _sums_of_all_views(
    linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient], held: TestedSum, every: Indices
) -> list[TestedSum]:
    """Return the sums of these ingredients that all views suggest beside the scatter that a sum which holds leaves.

    All views know better than some which sum it is: the likeliest first (Bayesian information criterion).
    """
    whole = HalfModel(_with_refitted_scatter(linear, terms, held.ingredients), terms, every)
    sums = [*_suggested_sums(whole, ingredients), refine_parameters(held.ingredients, whole)]
    likely = sorted(sums, key=lambda addends: _information_criterion(addends, whole))[:_TESTED_SUMS]
    return [replace(held, ingredients=round_parameters(addends), instead_of=held.ingredients) for addends in likely]


def _information_criterion(ingredients: tuple[Ingredient, ...], half: HalfModel) -> float:
    """Schwarz 1978, with the scatter unknown; places, widths and periods are numbers too."""
    residual = sum_residual(ingredients, half)
    numbers = len(ingredients) + sum(len(q.nonlinear) for q in quantities_of(ingredients))
    return float(half.free * np.log(residual @ residual) + np.log(half.free) * numbers)


def _test_beside_scatter(
    linear: LinearModel, terms: Dictionary, ingredients: tuple[Ingredient, ...], splits: Sequence[Indices]
) -> TestedSum:
    """Test a sum under the scatter that is left beside it.

    Args:
        splits: views in which the sum was chosen, and those in which it is tested; both leave numbers free beside it.
    """
    columns = terms.columns(ingredients)
    chosen = HalfModel(linear.restricted(()), terms, splits[0])
    fitted = np.linalg.lstsq(chosen.residual_columns(columns), chosen.z, rcond=None)[0]
    sizes = _PRIOR_WIDTH * np.abs(fitted) + _MIN_PRIOR_SIGMA
    slow = ingredients[0].quantity.slow
    base = _with_test_scatter(linear, linear.reduce(columns), sizes, slow)
    halves = [HalfModel(base, terms, views) for views in splits]
    return _test_sum(ingredients, *((half.residual_columns(columns), half.z) for half in halves))


def _with_refitted_scatter(linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient]) -> LinearModel:
    """Return the model under the scatter that a sum leaves."""
    beside = linear.conditioned_on(linear.reduce(terms.columns(ingredients)), np.full(len(ingredients), 1.0))
    return replace(linear, null=at_variances(linear.mixed, beside.null.variances))


def _with_test_scatter(linear: LinearModel, columns: Array, sizes: Array, slow: bool) -> LinearModel:
    """Return the model under the scatter that is left beside a sum, for a test of that sum.

    What the sum explains is no scatter. What wanders in time stays for a sum that follows time.
    """
    if slow and linear.pose_errors is None:
        return linear
    variances = linear.conditioned_on(columns, sizes).null.variances.copy()
    if slow:
        wanders = NOISE + 1 + np.flatnonzero(np.isin(linear.component_names, list(DRIFT_MEMORY)))
        variances[wanders] = np.maximum(variances, linear.null.variances)[wanders]
    return replace(linear, null=at_variances(linear.mixed, variances))


def _test_sum(
    ingredients: tuple[Ingredient, ...], chosen: tuple[Array, Array], tested: tuple[Array, Array]
) -> TestedSum:
    """Test a sum by its columns and the numbers of either half, in units of the scatter."""
    (A, y), (B, w) = chosen, tested
    inverse = np.linalg.pinv(B.T @ B, rcond=1e-12, hermitian=True)
    square = float((B.T @ w) @ inverse @ (B.T @ w))
    factor = _log_predictive_ratio(A, y, B, w)
    both = factor + _log_predictive_ratio(B, w, A, y)
    return TestedSum(ingredients, chi2_tail(square, len(ingredients)), factor, both)


def _log_predictive_ratio(A: Array, y: Array, B: Array, w: Array) -> float:
    """Log likelihood ratio of w = B·x for what y = A·x tells of x, over none."""
    mean = np.asarray(np.linalg.lstsq(A, y, rcond=None)[0], float)
    precision = A.T @ A + np.diag((_PRIOR_WIDTH * np.abs(mean) + _MIN_PRIOR_SIGMA) ** -2.0)
    return float(log_evidence(B.T @ B, B.T @ w, precision, mean))
