"""Nonlinear parameters of a sum (places, widths, periods) moved to where they explain most, sizes projected out.

Golub & Pereyra 1973, SIAM J. Numer. Anal. 10:413 (variable projection). A normal prior about where the search found
them keeps finite what the views do not tell.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from stitch.explanation.dictionary import Ingredient
from stitch.explanation.half import HalfModel
from stitch.explanation.quantity import Quantity
from stitch.frames import Array

_MOST = 20  # steps
# Of teeth, in the spreads of tooth and jump: a tenth of the tooth either way, and all places of the jump.
_TEETH, _JUMPS = np.linspace(-2, 2, 13), np.linspace(-5, 5, 20, endpoint=False)


def refine_parameters(ingredients: Sequence[Ingredient], half: HalfModel) -> tuple[Ingredient, ...]:
    """The same ingredients, their quantities as some views want them."""
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
    """With teeth tried over a grid: where a view passes a jump no slope shows it."""
    for q in quantities_of(ingredients):
        if q.kind == "teeth":
            tried = [_with_moved_parameters(ingredients, [q], np.array(steps)) for steps in product(_TEETH, _JUMPS)]
            ingredients = min(tried, key=lambda own: float(np.sum(sum_residual(own, half) ** 2)))
    return ingredients


def round_parameters(ingredients: Sequence[Ingredient]) -> tuple[Ingredient, ...]:
    """With nonlinear parameters that a person can read."""
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
