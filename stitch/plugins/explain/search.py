"""Sparse regression over a dictionary: chosen in some of the views, tested in the others.

In some of the views ingredients are added greedily (orthogonal matching pursuit), after the first as long as the next
one explains more than the best of all of them would by chance, and places, widths and periods are moved to where they
explain most. The others, which took no part in that, then say if the same sum of ingredients is wanted there
(held_test). Halves and thirds change roles, and all ways are counted. Where one holds, all views say which sum it is.

What follows the arm is asked for in views taken alternately. What follows time, or what moves with time, in the first
and the second half of the session too, and always beside errors that wander as much as all views show: these look the
same in views that are neighbours in time.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from stitch.diagnosis.thresholds import CONFIRMED_FORMULA, FALSE_ADDEND, ODDS
from stitch.numerics.distributions import chi2_tail, f_tail
from stitch.numerics.frames import Array, Indices
from stitch.numerics.least_squares import column_space
from stitch.numerics.parameter_selection import log_evidence
from stitch.numerics.reml import NOISE, at_variances
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import DRIFT_MEMORY
from stitch.plugins.explain.dictionary import Dictionary, Ingredient, Quantity, group_addends, scaled_values
from stitch.session.scan import even_indices

# Some of the views, as one who knows nothing of the others sees them.

# Of a number a view two views show one difference: in that all that differ are alike, but for their size.
_MIN_VIEWS = 2


class HalfModel:
    """Numbers (n,) of some views in units of their scatter, without what the model explains there."""

    def __init__(self, linear: LinearModel, terms: Dictionary, keep: Indices) -> None:
        """Restrict a linear model to the views to keep; all others move freely."""
        self._linear, self._terms, self._keep = linear, terms, keep
        # Where each view is a block of its own, the blocks and the numbers of those kept; of surfaces views share all.
        self._blocks = None if linear.observation.numbers_per_view is None else keep
        size = linear.mixed.z.shape[1]
        rows = (keep[:, None] * size + np.arange(size)).ravel()
        self._rows: slice | Indices = slice(None) if self._blocks is None else rows
        self._of_view = dict[tuple[str, int], Array]()

    @cached_property
    def _explained(self) -> Array:
        """(n, r) orthonormal."""
        linear = self._linear
        out = np.setdiff1d(np.arange(linear.measurement.views.count), self._keep)
        if self._blocks is None and len(out):
            return linear.explained_without(out)
        return column_space(linear.white_design[self._rows])

    @cached_property
    def z(self) -> Array:
        """(n,) what was seen."""
        white = self._linear.white_z[self._rows]
        return np.asarray(white - self._explained @ (self._explained.T @ white))

    @property
    def free(self) -> int:
        """Return how many of the numbers are free."""
        return len(self.z) - int(self._explained.shape[1])

    def has_room(self, numbers: int = 1) -> bool:
        """True if these views can tell a sum of so many numbers from others, and leave numbers free beside it."""
        return len(self._keep) > _MIN_VIEWS and self.free > numbers

    @property
    def views(self) -> Indices:
        """Numbers of those kept."""
        return self._keep

    def residual_columns(self, response: Array) -> Array:
        """(n, k) whitened columns of a response (·, k), without what the model explains."""
        white = self._linear.whiten(self._linear.reduce(response), self._blocks)
        return np.asarray(white - self._explained @ (self._explained.T @ white))

    def columns(self, ingredients: Sequence[Ingredient]) -> Array:
        """(n, k) of ingredients: from the response to each view's displacement alone, which is worked out once."""
        out = np.empty((len(self.z), len(ingredients)))
        at = [(i.place, i.index) for i in ingredients]
        for own in dict.fromkeys(at):
            which = [k for k, other in enumerate(at) if other == own]
            values = np.stack([scaled_values(ingredients[k].quantity)[self._keep] for k in which], axis=1)
            out[:, which] = self._view_by_view(ingredients[which[0]]) @ values
        return out

    def _view_by_view(self, ingredient: Ingredient) -> Array:
        """(n, kept views) of a displacement in one view at a time."""
        own = ingredient.place, ingredient.index
        if own not in self._of_view:
            base = self._terms.base(ingredient).reshape(-1, self._terms.rows)
            alone = np.zeros((*base.shape, len(self._keep)))
            alone[self._keep, :, np.arange(len(self._keep))] = base[self._keep]
            self._of_view[own] = self.residual_columns(alone.reshape(-1, len(self._keep)))
        return self._of_view[own]


# Whether a sum of ingredients that one half of the views suggests is what the other half, which took no part, shows.
#
# Beside everything else that poses may err by, under the scatter that is left once the sum is taken out: a χ² test, and
# how much likelier the numbers of that half are with the sizes that the first half found (a partial Bayes factor;
# Berger & Pericchi 1996, J. Am. Stat. Assoc. 91:109).

# A prior of this many sizes as they come out keeps what a half does not see finite.
_PRIOR_WIDTH = 10.0
_MIN_PRIOR_SIGMA = 1e-6


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


def test_refitted_scatter(
    linear: LinearModel, terms: Dictionary, ingredients: tuple[Ingredient, ...], slow: bool, splits: Sequence[Indices]
) -> TestedSum:
    """The test under the scatter that is left beside the sum.

    Args:
        slow: the sum follows time or what moves with it.
        splits: views in which the sum was chosen, and those in which it is tested; both leave numbers free beside it.
    """
    own = terms.columns(ingredients)
    other = HalfModel(linear.restricted(()), terms, splits[0])
    sizes = (
        _PRIOR_WIDTH * np.abs(np.linalg.lstsq(other.residual_columns(own), other.z, rcond=None)[0]) + _MIN_PRIOR_SIGMA
    )
    base = _with_test_scatter(linear, linear.reduce(own), sizes, slow)
    halves = [HalfModel(base, terms, views) for views in splits]
    return _test_sum(ingredients, *((half.residual_columns(own), half.z) for half in halves))


def fitted_sizes(linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient]) -> Array:
    """(k,) sizes of scaled columns from all views, under the scatter that they leave."""
    base, own = with_refitted_scatter(linear, terms, ingredients), linear.reduce(terms.columns(ingredients))
    return np.asarray(np.linalg.lstsq(base.residual(own), base.white_residual, rcond=None)[0])


def with_refitted_scatter(linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient]) -> LinearModel:
    """The model under the scatter that a sum leaves."""
    beside = linear.conditioned_on(linear.reduce(terms.columns(ingredients)), np.full(len(ingredients), 1.0))
    return replace(linear, null=at_variances(linear.mixed, beside.null.variances))


def _test_sum(
    ingredients: tuple[Ingredient, ...], chosen: tuple[Array, Array], tested: tuple[Array, Array]
) -> TestedSum:
    """A sum by its columns and the numbers of either half, in units of the scatter."""
    (A, y), (B, w) = chosen, tested
    told = np.linalg.pinv(B.T @ B, rcond=1e-12, hermitian=True)
    square = float((B.T @ w) @ told @ (B.T @ w))
    factor = _log_predictive_ratio(A, y, B, w)
    return TestedSum(
        ingredients, chi2_tail(square, len(ingredients)), factor, factor + _log_predictive_ratio(B, w, A, y)
    )


def _with_test_scatter(linear: LinearModel, own: Array, sizes: Array, slow: bool) -> LinearModel:
    """Under the scatter that is left beside a sum: what it explains is no scatter. What wanders in time stays."""
    if slow and linear.pose_errors is None:
        return linear
    variances = linear.conditioned_on(own, sizes).null.variances.copy()
    if slow:
        wanders = NOISE + 1 + np.flatnonzero(np.isin(linear.component_names, list(DRIFT_MEMORY)))
        variances[wanders] = np.maximum(variances, linear.null.variances)[wanders]
    return replace(linear, null=at_variances(linear.mixed, variances))


def _log_predictive_ratio(A: Array, y: Array, B: Array, w: Array) -> float:
    """Log likelihood ratio of w = B·x for what y = A·x tells of x, over none."""
    mean = np.asarray(np.linalg.lstsq(A, y, rcond=None)[0], float)
    precision = A.T @ A + np.diag((_PRIOR_WIDTH * np.abs(mean) + _MIN_PRIOR_SIGMA) ** -2.0)
    return float(log_evidence(B.T @ B, B.T @ w, precision, mean))


# Orthogonal matching pursuit over addends of one or several columns (Pati, Rezaiifar & Krishnaprasad 1993, ACSSC;
# groups: Lozano, Świrszcz & Abe 2009, NIPS 22).

_AT_MOST = 4  # numbers of a sum, unless one addend has more
# Columns shorter than this share of the longest lie almost wholly in what the model explains; of a column's length less
# is another's.
_MIN_COLUMN_NORM, _INDEPENDENT_SHARE = 1e-6, 0.1
_WHOLE = 1 - 1e-12  # of what is left, no more is believed to be explained

# Columns (n, k) of a sum, by its numbers.
SumColumns = Callable[[tuple[int, ...]], Array]


def pursue_sums(
    design: Array,
    z: Array,
    free: int,
    addends: Sequence[tuple[int, ...]],
    starts: int,
    refined_columns: SumColumns | None = None,
) -> set[tuple[int, ...]]:
    """Sums that explain z (n,), of which so many numbers are free: numbers of their columns in `design` (n, M).

    One for each of the best addends to begin with, and each with a further addend as long as the next explains more
    than the best of all would by chance. Addends of different size are compared by the Bayesian information criterion
    (Schwarz 1978), with the scatter unknown.

    Args:
        refined_columns: columns in the place of those in `design`, which tell what is left for the next addend.
    """
    strength = np.linalg.norm(design, axis=0)
    usable = strength > _MIN_COLUMN_NORM * strength.max(initial=0.0)
    unit = np.where(usable, design / np.maximum(strength, 1e-300), 0.0)
    sizes = np.array([len(own) for own in addends])
    alike = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
    groups = [_AddendGroup(which, np.array([addends[int(k)] for k in which], np.int64)) for which in alike]
    asked = _PursuitProblem(unit, z, free, addends, groups)
    worth, _, ranks, _ = asked.score_addends(np.zeros((len(z), 0)))
    first = np.argsort(-worth)[:starts]
    every = [asked.sums_from(int(k), refined_columns or (lambda own: design[:, own])) for k in first[ranks[first] > 0]]
    return {sum_ for sums in every for sum_ in sums}


@dataclass(frozen=True)
class _AddendGroup:
    """Addends of one size."""

    which: Indices  # (g,)
    columns: Indices  # (g, k)


@dataclass(frozen=True)
class _PursuitProblem:
    """What is to be explained, and by which addends."""

    unit: Array  # (n, M) columns of unit length
    z: Array  # (n,)
    free: int
    addends: Sequence[tuple[int, ...]]
    groups: Sequence[_AddendGroup]

    def sums_from(self, k: int, refined: SumColumns) -> list[tuple[int, ...]]:
        """The sum of one addend, of that and the best further one, and so on."""
        sums = [self.addends[k]]
        while len(sums[-1]) < _AT_MOST:
            worth, gains, ranks, rest = self.score_addends(_basis(refined(sums[-1])))
            # What it holds may have moved, and would seem to be wanted once more where it stood.
            inside = set(sums[-1])
            held = [inside.issuperset(own) for own in self.addends]
            worth, ranks = np.where(held, -np.inf, worth), np.where(held, 0, ranks)
            k = int(worth.argmax())
            rank = int(ranks[k])
            left = self.free - len(sums[-1]) - rank
            if not rank or left < 1:
                break
            F = gains[k] / rank / max((rest - gains[k]) / left, 1e-300)
            if f_tail(F, rank, left) > FALSE_ADDEND / len(self.addends):
                break
            # Addends may share a number: a spring stands alone and with how it stiffens.
            sums.append(tuple(dict.fromkeys((*sums[-1], *self.addends[k]))))
        return sums

    def score_addends(self, basis: Array) -> tuple[Array, Array, Indices, float]:
        """(G,) worth, gain and rank of every addend beside what lies in a basis (n, r), and the square that is left."""
        unit, rest = self.unit - basis @ (basis.T @ self.unit), self.z - basis @ (basis.T @ self.z)
        gains, ranks = _explained_squares(unit, rest, self.groups, len(self.addends))
        return _information_criterion(gains, ranks, rest, self.free - basis.shape[1]), gains, ranks, float(rest @ rest)


def _information_criterion(gains: Array, ranks: Indices, z: Array, free: int) -> Array:
    """(G,) Bayesian information criterion of every addend, less that of none."""
    shares = np.minimum(gains / max(float(z @ z), 1e-300), _WHOLE)
    worth = -free * np.log1p(-shares) - np.log(max(free, 2)) * ranks
    return np.asarray(np.where(ranks > 0, worth, -np.inf))


def _explained_squares(unit: Array, z: Array, groups: Sequence[_AddendGroup], count: int) -> tuple[Array, Indices]:
    """(G,) squares of z that every addend explains, and its rank; directions of which little is left do not count."""
    gains, ranks, along = np.zeros(count), np.zeros(count, np.int64), unit.T @ z
    for group in groups:
        if group.columns.shape[1] == 1:
            k = group.columns[:, 0]
            squares = np.einsum("nk,nk->k", unit[:, k], unit[:, k])
            told = squares > _INDEPENDENT_SHARE**2
            gains[group.which] = np.where(told, along[k] ** 2 / np.maximum(squares, 1e-300), 0.0)
            ranks[group.which] = told
            continue
        own = np.moveaxis(unit[:, group.columns], 0, 1)  # (g, n, k)
        values, vectors = np.linalg.eigh(own.transpose(0, 2, 1) @ own)
        told = values > _INDEPENDENT_SHARE**2
        shares = np.einsum("gk,gkr->gr", along[group.columns], vectors) ** 2 / np.maximum(values, 1e-300)
        gains[group.which], ranks[group.which] = np.where(told, shares, 0.0).sum(axis=1), told.sum(axis=1)
    return gains, ranks


def _basis(columns: Array) -> Array:
    """(n, r) orthonormal."""
    unit = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    U, left, _ = np.linalg.svd(unit, full_matrices=False)
    return np.asarray(U[:, left > _INDEPENDENT_SHARE / 2])  # of a column of which so much is left beside another


# Nonlinear parameters of a sum (places, widths, periods) moved to where they explain most, sizes projected out.
#
# Golub & Pereyra 1973, SIAM J. Numer. Anal. 10:413 (variable projection). A normal prior about where the search found
# them keeps finite what the views do not tell.

_MOST = 20  # steps
# Of teeth, in the spreads of tooth and jump: a tenth of the tooth either way, and all places of the jump.
_TEETH, _JUMPS = np.linspace(-2, 2, 13), np.linspace(-5, 5, 20, endpoint=False)


def refine_parameters(ingredients: Sequence[Ingredient], half: HalfModel) -> tuple[Ingredient, ...]:
    """Refine the quantities of ingredients for some views."""
    ingredients = _scan_teeth(ingredients, half)
    tuned = [q for q in quantities_of(ingredients) if q.nonlinear]
    count = sum(len(q.nonlinear) for q in tuned)
    if not count:
        return tuple(ingredients)
    scatter = sum_residual(ingredients, half)
    # Beside its sum what is left is scatter: of about one where the scatter was known.
    scale = np.sqrt(float(scatter @ scatter) / max(half.free - len(ingredients) - count, 1))

    def off(steps: Array) -> Array:
        return np.append(sum_residual(_with_moved_parameters(ingredients, tuned, steps), half) / scale, steps)

    found = least_squares(off, np.zeros(count), method="lm", max_nfev=_MOST * (count + 1))
    return _with_moved_parameters(ingredients, tuned, found.x)


def _scan_teeth(ingredients: Sequence[Ingredient], half: HalfModel) -> Sequence[Ingredient]:
    """Try teeth over a grid: where a view passes a jump no slope shows it."""
    for q in quantities_of(ingredients):
        if q.kind == "teeth":
            tried = [_with_moved_parameters(ingredients, [q], np.array(steps)) for steps in product(_TEETH, _JUMPS)]
            ingredients = min(tried, key=lambda own: float(np.sum(sum_residual(own, half) ** 2)))
    return ingredients


def round_parameters(ingredients: Sequence[Ingredient]) -> tuple[Ingredient, ...]:
    """Round nonlinear parameters for people."""
    return tuple(replace(i, quantity=i.quantity.rounded()) for i in ingredients)


def quantities_of(ingredients: Sequence[Ingredient]) -> list[Quantity]:
    """All different ones: the axes of a body follow one."""
    return list({i.quantity.text: i.quantity for i in ingredients}.values())


def _with_moved_parameters(
    ingredients: Sequence[Ingredient], tuned: Sequence[Quantity], steps: Array
) -> tuple[Ingredient, ...]:
    ends = np.cumsum([len(q.nonlinear) for q in tuned])[:-1]
    new = {q.text: q.moved(own) for q, own in zip(tuned, np.split(steps, ends), strict=True)}
    return tuple(replace(i, quantity=new.get(i.quantity.text, i.quantity)) for i in ingredients)


def sum_residual(ingredients: Sequence[Ingredient], half: HalfModel) -> Array:
    """(n,) what a sum leaves, with the best sizes."""
    columns = half.columns(ingredients)
    return np.asarray(half.z - columns @ np.linalg.lstsq(columns, half.z, rcond=1e-9)[0])


# Which sums some of the views suggest, and which of them the others want.

_FIRST, _TESTED = 8, 3  # addends with which a sum is begun; sums of some views, or of all, that are tested further
_REPORTED_SUMS = 6  # sums, the likeliest
_ENOUGH = 300  # views of a half
_BLOCKS = 16  # of neighbours in time, for views that share a wandering error which no prior knows


def search_sums(linear: LinearModel, terms: Dictionary) -> list[TestedSum]:
    """Sums of ingredients at one place: those that hold first, the likeliest of them before the others; with places,
    widths and periods as all views want them, and sums that all views suggest where one of theirs holds."""
    found, ways, groups = list[TestedSum](), 0, defaultdict[tuple[str, bool], list[Ingredient]](list)
    for i in terms.ingredients:
        groups[_ingredient_group(i)].append(i)
    for (_, slow), some in sorted(groups.items(), key=lambda own: own[0]):
        for chosen, other in _half_models(linear, terms, slow):
            found += _search_split(linear, terms, some, chosen, other)
            ways += 1
    found = [replace(c, p_value=min(1.0, ways * c.p_value)) for c in found]
    # Each was chosen in some views: what they and the others say of it counts.
    found.sort(key=lambda c: (not c.holds, -c.both))
    every = _thinned_views(np.arange(linear.measurement.views.count), 2)
    whole = HalfModel(linear.restricted(()), terms, every)
    told = [
        replace(c, ingredients=round_parameters(refine_parameters(c.ingredients, whole)))
        for c in found[:_REPORTED_SUMS]
    ]
    if not found or not found[0].holds:
        return told
    return [
        *_sums_of_all_views(linear, terms, groups[_ingredient_group(found[0].ingredients[0])], found[0], every),
        *told,
    ]


def enough_views(linear: LinearModel, terms: Dictionary) -> bool:
    """True if some of the views may choose a sum, and others test it."""
    return next(_half_models(linear, terms, slow=True), None) is not None


def _ingredient_group(ingredient: Ingredient) -> tuple[str, bool]:
    """What ingredients that may stand in one sum have in common."""
    return ingredient.place, ingredient.quantity.slow


def _half_models(linear: LinearModel, terms: Dictionary, slow: bool) -> Iterator[tuple[HalfModel, HalfModel]]:
    """Views in which a sum is chosen, and those in which it is tested, as long as either may say something of one."""
    for views in _view_splits(linear, slow):
        chosen, other = (HalfModel(linear.restricted(()), terms, own) for own in views)
        if chosen.has_room() and other.has_room():
            yield chosen, other


def _view_splits(linear: LinearModel, slow: bool) -> list[tuple[Indices, Indices]]:
    """Views in which a sum is chosen, and those in which it is tested."""
    # Over the same region of poses: view by view, or in blocks of time.
    count = linear.measurement.views.count
    blocks = count if linear.observation.numbers_per_view is None else min(_BLOCKS, count)
    block = np.arange(count) * blocks // count
    parts = [[np.flatnonzero(block % n == k) for k in range(n)] for n in (2, 3)]
    parts += [np.array_split(np.arange(count), 2)] if slow else []
    return [
        (_thinned_views(np.sort(np.concatenate([*own[:k], *own[k + 1 :]]))), _thinned_views(own[k]))
        for own in parts
        for k in range(len(own))
        if len(own[k])
    ]


def _sums_of_all_views(
    linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient], held: TestedSum, every: Indices
) -> list[TestedSum]:
    """Choose among sums once one holds: all views know better than some which sum it is. Those that they
    suggest of the same ingredients, likeliest first (Bayesian information criterion), beside the scatter that it
    leaves."""
    base = with_refitted_scatter(linear, terms, held.ingredients)
    whole = HalfModel(base, terms, every)
    sums = [*_suggested_sums(whole, ingredients), refine_parameters(held.ingredients, whole)]
    likely = sorted(sums, key=lambda sum_: _criterion(sum_, whole))[:_TESTED]
    return [replace(held, ingredients=round_parameters(sum_), instead_of=held.ingredients) for sum_ in likely]


def _criterion(ingredients: tuple[Ingredient, ...], half: HalfModel) -> float:
    """Schwarz 1978, with the scatter unknown; places, widths and periods are numbers too."""
    left = sum_residual(ingredients, half)
    numbers = len(ingredients) + sum(len(q.nonlinear) for q in quantities_of(ingredients))
    return float(half.free * np.log(left @ left) + np.log(half.free) * numbers)


def _thinned_views(views: Indices, halves: int = 1) -> Indices:
    """Evenly over them: more of thousands would tell nothing new, and their columns fill the memory."""
    enough = halves * _ENOUGH
    return views if len(views) <= enough else views[even_indices(len(views), enough)]


def _search_split(
    linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient], chosen: HalfModel, other: HalfModel
) -> list[TestedSum]:
    """Find what a half suggests, begun with each of its best addends, and test it in the other."""
    suggested = [
        sum_
        for sum_ in _suggested_sums(chosen, ingredients)
        if chosen.has_room(len(sum_)) and other.has_room(len(sum_))
    ]
    # What is worth nothing under the present scatter is not worth a search for the scatter beside it.
    both = (chosen, other)
    worth = [_test_sum(own, *((half.columns(own), half.z) for half in both)).log_bayes_factor for own in suggested]
    likely = [suggested[k] for k in np.argsort(-np.array(worth), kind="stable")[:_TESTED]]
    slow = ingredients[0].quantity.slow
    tested = [test_refitted_scatter(linear, terms, sum_, slow, (chosen.views, other.views)) for sum_ in likely]
    return [replace(c, p_value=min(1.0, len(suggested) * c.p_value)) for c in tested]


def _suggested_sums(half: HalfModel, ingredients: Sequence[Ingredient]) -> list[tuple[Ingredient, ...]]:
    """Sums that explain some views, as these want their places, widths and periods."""
    found = dict[tuple[int, ...], tuple[Ingredient, ...]]()

    def columns(numbers: tuple[int, ...]) -> Array:
        if numbers not in found:
            found[numbers] = refine_parameters([ingredients[k] for k in numbers], half)
        return half.columns(found[numbers])

    sums = pursue_sums(half.columns(ingredients), half.z, half.free, group_addends(ingredients), _FIRST, columns)
    for numbers in sums - found.keys():
        columns(numbers)
    return [found[numbers] for numbers in sorted(sums)]
