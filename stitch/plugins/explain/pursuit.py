"""Sums of addends that explain some views: chosen one addend after the other, their nonlinear parameters moved.

Orthogonal matching pursuit over addends of one or several columns (Pati, Rezaiifar & Krishnaprasad 1993, ACSSC; groups:
Lozano, Świrszcz & Abe 2009, NIPS 22). Places, widths and periods go where they explain most, with the sizes projected
out (Golub & Pereyra 1973, SIAM J. Numer. Anal. 10:413). A normal prior about where the search found them keeps finite
what the views do not tell.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from stitch.diagnosis.thresholds import FALSE_ADDEND
from stitch.numerics.distributions import f_tail
from stitch.numerics.frames import Array, Indices
from stitch.plugins.explain.dictionary import Ingredient
from stitch.plugins.explain.half_model import HalfModel, sum_residual
from stitch.plugins.explain.quantities import Quantity

_MOST_NUMBERS = 4  # of a sum, unless one addend has more
# Columns shorter than this share of the longest lie almost wholly in what the model explains.
_MIN_COLUMN_NORM = 1e-6
# A column of which a smaller share is left beside others is theirs.
_INDEPENDENT_SHARE = 0.1
_WHOLE = 1 - 1e-12  # of what is left, no more is believed to be explained
_STEPS_A_PARAMETER = 20
# Of teeth, in the spreads of tooth and jump: a tenth of the tooth either way, and all places of the jump.
_TOOTH_STEPS = np.linspace(-2, 2, 13)
_JUMP_STEPS = np.linspace(-5, 5, 20, endpoint=False)

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
    """Return sums that explain z (n,), each as the numbers of its columns in `design` (n, M).

    There is one for each of the best addends to begin with, and each with a further addend as long as the next explains
    more than the best of all would by chance. Addends of different size are compared by the Bayesian information
    criterion (Schwarz 1978), with the scatter unknown.

    Args:
        free: how many of the numbers z are free.
        starts: with how many of the best addends a sum is begun.
        refined_columns: columns in the place of those in `design`, which tell what is left for the next addend.
    """
    strength = np.linalg.norm(design, axis=0)
    usable = strength > _MIN_COLUMN_NORM * strength.max(initial=0.0)
    unit = np.where(usable, design / np.maximum(strength, 1e-300), 0.0)
    sizes = np.array([len(columns) for columns in addends])
    alike = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
    groups = [(which, np.array([addends[int(k)] for k in which], np.int64)) for which in alike]
    problem = _PursuitProblem(unit, z, free, addends, groups)
    worth, _, ranks, _ = problem.score_addends(np.zeros((len(z), 0)))
    best = np.argsort(-worth)[:starts]
    columns_of = refined_columns or (lambda numbers: design[:, numbers])
    return {numbers for k in best[ranks[best] > 0] for numbers in problem.sums_from(int(k), columns_of)}


@dataclass(frozen=True)
class _PursuitProblem:
    """What is to be explained, and by which addends."""

    unit: Array  # (n, M) columns of unit length
    z: Array  # (n,)
    free: int
    addends: Sequence[tuple[int, ...]]
    groups: Sequence[tuple[Indices, Indices]]  # of addends of one size k: which (g,), and their columns (g, k)

    def sums_from(self, k: int, refined: SumColumns) -> list[tuple[int, ...]]:
        """Return the sum of one addend, of that and the best further one, and so on."""
        sums = [self.addends[k]]
        while len(sums[-1]) < _MOST_NUMBERS:
            worth, gains, ranks, rest = self.score_addends(_basis(refined(sums[-1])))
            # What it holds may have moved, and would seem to be wanted once more where it stood.
            inside = set(sums[-1])
            held = [inside.issuperset(columns) for columns in self.addends]
            worth = np.where(held, -np.inf, worth)
            ranks = np.where(held, 0, ranks)
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
        """Return worth, gain and rank (G,) of every addend beside what lies in a basis (n, r), and the square left."""
        unit = self.unit - basis @ (basis.T @ self.unit)
        rest = self.z - basis @ (basis.T @ self.z)
        gains, ranks = _explained_squares(unit, rest, self.groups, len(self.addends))
        return _information_criterion(gains, ranks, rest, self.free - basis.shape[1]), gains, ranks, float(rest @ rest)


def _information_criterion(gains: Array, ranks: Indices, z: Array, free: int) -> Array:
    """(G,) Bayesian information criterion of every addend, less that of none."""
    shares = np.minimum(gains / max(float(z @ z), 1e-300), _WHOLE)
    worth = -free * np.log1p(-shares) - np.log(max(free, 2)) * ranks
    return np.where(ranks > 0, worth, -np.inf)


def _explained_squares(
    unit: Array, z: Array, groups: Sequence[tuple[Indices, Indices]], count: int
) -> tuple[Array, Indices]:
    """Return the squares (G,) of z that every addend explains, and its rank.

    Directions of which little is left do not count.
    """
    gains = np.zeros(count)
    ranks = np.zeros(count, np.int64)
    along = unit.T @ z
    for which, columns in groups:
        if columns.shape[1] == 1:
            k = columns[:, 0]
            squares = np.einsum("nk,nk->k", unit[:, k], unit[:, k])
            independent = squares > _INDEPENDENT_SHARE**2
            gains[which] = np.where(independent, along[k] ** 2 / np.maximum(squares, 1e-300), 0.0)
            ranks[which] = independent
            continue
        stacked = np.moveaxis(unit[:, columns], 0, 1)  # (g, n, k)
        values, vectors = np.linalg.eigh(stacked.transpose(0, 2, 1) @ stacked)
        independent = values > _INDEPENDENT_SHARE**2
        shares = np.einsum("gk,gkr->gr", along[columns], vectors) ** 2 / np.maximum(values, 1e-300)
        gains[which] = np.where(independent, shares, 0.0).sum(axis=1)
        ranks[which] = independent.sum(axis=1)
    return gains, ranks


def _basis(columns: Array) -> Array:
    """Return an orthonormal basis (n, r) of columns."""
    unit = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    U, values, _ = np.linalg.svd(unit, full_matrices=False)
    return U[:, values > _INDEPENDENT_SHARE / 2]  # of a column of which so much is left beside another


def quantities_of(ingredients: Sequence[Ingredient]) -> list[Quantity]:
    """Return all different quantities: the axes of a body follow one."""
    return list({i.quantity.text: i.quantity for i in ingredients}.values())


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

    def residuals(steps: Array) -> Array:
        return np.append(sum_residual(_with_moved_parameters(ingredients, tuned, steps), half) / scale, steps)

    solution = least_squares(residuals, np.zeros(count), method="lm", max_nfev=_STEPS_A_PARAMETER * (count + 1))
    return _with_moved_parameters(ingredients, tuned, solution.x)


def _scan_teeth(ingredients: Sequence[Ingredient], half: HalfModel) -> Sequence[Ingredient]:
    """Try teeth over a grid: where a view passes a jump no slope shows it."""
    for q in quantities_of(ingredients):
        if q.kind == "teeth":
            tried = [
                _with_moved_parameters(ingredients, [q], np.array(steps))
                for steps in product(_TOOTH_STEPS, _JUMP_STEPS)
            ]
            ingredients = min(tried, key=lambda moved: float(np.sum(sum_residual(moved, half) ** 2)))
    return ingredients


def round_parameters(ingredients: Sequence[Ingredient]) -> tuple[Ingredient, ...]:
    """Round nonlinear parameters for people."""
    return tuple(replace(i, quantity=i.quantity.rounded()) for i in ingredients)


def _with_moved_parameters(
    ingredients: Sequence[Ingredient], tuned: Sequence[Quantity], steps: Array
) -> tuple[Ingredient, ...]:
    ends = np.cumsum([len(q.nonlinear) for q in tuned])[:-1]
    new = {q.text: q.moved(part) for q, part in zip(tuned, np.split(steps, ends), strict=True)}
    return tuple(replace(i, quantity=new.get(i.quantity.text, i.quantity)) for i in ingredients)
