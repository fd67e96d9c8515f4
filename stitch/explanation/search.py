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
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from stitch.explanation.dictionary import Dictionary, Ingredient, group_addends
from stitch.explanation.half import HalfModel
from stitch.explanation.held_test import TestedSum, test_current_scatter, test_refitted_scatter, with_refitted_scatter
from stitch.explanation.pursuit import pursue_sums
from stitch.explanation.refinement import quantities_of, refine_parameters, round_parameters, sum_residual
from stitch.frames import Array, Indices
from stitch.measurement.scan import even_indices
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import SurfaceObservation

_FIRST, _TESTED = 8, 3  # addends with which a sum is begun; sums of some views, or of all, that are tested further
_REPORTED_SUMS = 6  # sums, the likeliest
_ENOUGH = 300  # views of a half
_BLOCKS = 16  # of neighbours in time, for views that share a wandering error which no prior knows


def search_sums(linear: LinearModel, terms: Dictionary) -> list[TestedSum]:
    """Sums of ingredients at one place: those that hold first, the likeliest of them before the others; with places,
    widths and periods as all views want them, and sums that all views suggest where one of theirs holds."""
    found, ways, groups = list[TestedSum](), 0, _ingredient_groups(terms)
    for (_, slow), some in groups.items():
        for chosen, other in _half_models(linear, terms, slow):
            found += _search_split(linear, terms, some, chosen, other)
            ways += 1
    found = [replace(c, p_value=min(1.0, ways * c.p_value)) for c in found]
    # Each was chosen in some views: what they and the others say of it counts.
    found.sort(key=lambda c: (not c.holds, -c.both))
    every = _thinned_views(np.arange(_view_count(linear)), 2)
    whole = HalfModel(linear.scatter_only, terms, every)
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
    return ingredient.place, ingredient.quantity.slow


def _ingredient_groups(terms: Dictionary) -> dict[tuple[str, bool], list[Ingredient]]:
    """Ingredients that may stand in one sum."""
    found = defaultdict[tuple[str, bool], list[Ingredient]](list)
    for i in terms.ingredients:
        found[_ingredient_group(i)].append(i)
    return {own: found[own] for own in sorted(found)}


def _half_models(linear: LinearModel, terms: Dictionary, slow: bool) -> Iterator[tuple[HalfModel, HalfModel]]:
    """Views in which a sum is chosen, and those in which it is tested, as long as either may say something of one."""
    for views in _view_splits(linear, slow):
        chosen, other = (HalfModel(linear.scatter_only, terms, own) for own in views)
        if chosen.has_room() and other.has_room():
            yield chosen, other


def _view_splits(linear: LinearModel, slow: bool) -> list[tuple[Indices, Indices]]:
    """Views in which a sum is chosen, and those in which it is tested."""
    parts = [_alternating_parts(linear, parts) for parts in (2, 3)]
    parts += [np.array_split(np.arange(_view_count(linear)), 2)] if slow else []
    return [
        (_thinned_views(np.sort(np.concatenate([*own[:k], *own[k + 1 :]]))), _thinned_views(own[k]))
        for own in parts
        for k in range(len(own))
        if len(own[k])
    ]


def _sums_of_all_views(
    linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient], held: TestedSum, every: Indices
) -> list[TestedSum]:
    """Where a sum holds, there is something: which sum it is all views know better than some of them. Those that they
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


def _view_count(linear: LinearModel) -> int:
    return linear.measurement.views.count


def _alternating_parts(linear: LinearModel, parts: int) -> list[Indices]:
    """Parts over the same region of poses: view by view, or in blocks of time."""
    blocks = (
        _view_count(linear) if isinstance(linear.observation, SurfaceObservation) else min(_BLOCKS, _view_count(linear))
    )
    block = np.arange(_view_count(linear)) * blocks // _view_count(linear)
    return [np.flatnonzero(block % parts == k) for k in range(parts)]


def _thinned_views(views: Indices, halves: int = 1) -> Indices:
    """Evenly over them: more of thousands would tell nothing new, and their columns fill the memory."""
    enough = halves * _ENOUGH
    return views if len(views) <= enough else views[even_indices(len(views), enough)]


def _search_split(
    linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient], chosen: HalfModel, other: HalfModel
) -> list[TestedSum]:
    """What a half suggests, begun with each of its best addends, and how it stands the test in the other."""
    suggested = [
        sum_
        for sum_ in _suggested_sums(chosen, ingredients)
        if chosen.has_room(len(sum_)) and other.has_room(len(sum_))
    ]
    # What is worth nothing under the present scatter is not worth a search for the scatter beside it.
    worth = [test_current_scatter(sum_, chosen, other).log_bayes_factor for sum_ in suggested]
    likely = [suggested[k] for k in np.argsort(-np.array(worth), kind="stable")[:_TESTED]]
    slow = ingredients[0].quantity.slow
    tested = [test_refitted_scatter(linear, terms, sum_, slow, (chosen.views, other.views)) for sum_ in likely]
    return [replace(c, p_value=min(1.0, len(suggested) * c.p_value)) for c in tested]


def _suggested_sums(half: HalfModel, ingredients: Sequence[Ingredient]) -> list[tuple[Ingredient, ...]]:
    """Sums that explain some views, as these want their places, widths and periods."""
    found = dict[tuple[int, ...], tuple[Ingredient, ...]]()

    def sum_of(numbers: tuple[int, ...]) -> tuple[Ingredient, ...]:
        if numbers not in found:
            found[numbers] = refine_parameters([ingredients[k] for k in numbers], half)
        return found[numbers]

    def columns(numbers: tuple[int, ...]) -> Array:
        return half.columns(sum_of(numbers))

    sums = pursue_sums(half.columns(ingredients), half.z, half.free, group_addends(ingredients), _FIRST, columns)
    return [sum_of(numbers) for numbers in sorted(sums)]
