"""From unknown to a formula: what a model lacks, as a sum of products of what the cell knows of its views."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.score import Score, score
from stitch.diagnosis.thresholds import LARGEST_JOINT_ADDEND
from stitch.diagnosis.validation import cross_validate, extrapolate
from stitch.effects.contract import EFFECTS
from stitch.effects.user_file import load
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.plugins.explain.dictionary import Dictionary, Ingredient, build_dictionary, coefficient
from stitch.plugins.explain.formula_file import effect_source, formula_text
from stitch.plugins.explain.quantities import view_quantities
from stitch.plugins.explain.search import TestedSum, enough_views, fitted_sizes, search_sums
from stitch.system.threads import library_threads_off
from stitch.system.values import Value

EFFECT_NAME = "explained"
_TINY = 1e-12
_TOO_FEW = (
    "Nothing can be said from {} views. A formula is found in some of them and tested in the others; these are too few."
)


@dataclass(frozen=True, eq=False)
class Explanation(Value):
    """A formula of which views that took no part in finding it want the like too; or none.

    Example:
        >>> print(stitch.explain(run).why)
        Nothing can be said from 5 views. ...
    """

    found: bool
    why: str  # in one sentence
    formula: str = ""
    place: str = ""  # robot | mount | part
    tested: str = ""  # the formula that stood the test, of which p_value is; all views may want another in its place
    heldout_share: float = float("nan")  # mean square on views left out over that of the present model
    p_value: float = float("nan")
    source: str = ""  # a Python file of effects


def explain(linear: LinearModel, origin: str = "Found by `stitch explain`.") -> Explanation:
    """Look for a formula of the displacements that a model leaves unexplained.

    Args:
        origin: first line of the file of effects.
    """
    with library_threads_off():
        terms = build_dictionary(linear, view_quantities(linear.measurement.views))
        first: Explanation | None = None
        if not enough_views(linear, terms):
            return Explanation(False, _TOO_FEW.format(linear.measurement.views.count))
        for tested in search_sums(linear, terms):
            explanation = _try_sum(linear, terms, tested, origin)
            if explanation.found:
                return explanation
            first = first or explanation
            # What does not hold in the other views needs no further test.
            if not tested.holds:
                break
        return first or Explanation(False, "No joint angle, time or column of views.csv explains what is left.")


def _try_sum(linear: LinearModel, terms: Dictionary, chosen: TestedSum, origin: str) -> Explanation:
    """Try a sum that may hold as an effect among all views."""
    ingredients = chosen.ingredients
    scaled = fitted_sizes(linear, terms, ingredients)
    values = _coefficients(linear, ingredients, scaled)
    text = formula_text(ingredients, values)
    if not chosen.holds:
        failed = f"{text}, found in some of the views, fails in the others (p = {chosen.p_value:.2g})"
        return Explanation(False, f"No formula holds: {failed}.")
    turns = [abs(v if i.quantity.bounded else x) for i, v, x in zip(ingredients, values, scaled, strict=True)]
    if ingredients[0].place == "robot" and max(turns) > LARGEST_JOINT_ADDEND:
        return Explanation(
            False, f"{text} would turn a joint by more than any arm errs, {1e3 * LARGEST_JOINT_ADDEND:.0f} mrad."
        )
    source = effect_source(EFFECT_NAME, ingredients, values, f"{origin} {text}")
    scored = _score_effect(linear, source)
    left_out = cross_validate(linear, scored)
    if not left_out.helps or left_out.heldout >= 1:
        return Explanation(False, f"{text} explains the views, but not those left out with their neighbours.")
    beyond = extrapolate(linear, scored)
    if beyond is not None and not beyond.helps:
        return Explanation(False, f"{beyond.rejection_reason(text)}.")
    tested = text
    other = chosen.instead_of
    if other and not _are_same_sum(other, ingredients):
        # The formula that stood the test is another, in whose place all views want this one.
        tested = formula_text(other, _coefficients(linear, other, fitted_sizes(linear, terms, other)))
    why = f"{text}: {_test_sentence(chosen.p_value, text, tested)}."
    return Explanation(
        True, why, text, ingredients[0].place, tested, left_out.heldout, p_value=chosen.p_value, source=source
    )


def _coefficients(linear: LinearModel, ingredients: Sequence[Ingredient], scaled: Array) -> list[float]:
    """Convert sizes (k,) of scaled columns into each ingredient's unit."""
    unit = linear.measurement.length_unit
    return [coefficient(i, float(x), unit) for i, x in zip(ingredients, scaled, strict=True)]


def _test_sentence(p_value: float, text: str, tested: str) -> str:
    """Say how the reported formula stood the test, or which one did."""
    # As far as anybody can vouch for the tails of a distribution.
    p = f"p = {p_value:.1g}" if p_value > _TINY else f"p < {_TINY:g}"
    if tested == text:
        return f"found in some of the views, it holds in the others ({p})"
    return (
        f"likeliest in all views, but not the one tested. Found in some and holding in the others: {tested} "
        f"({p}, for this one alone)"
    )


def _are_same_sum(some: Sequence[Ingredient], others: Sequence[Ingredient]) -> bool:
    """True of what a person would call the same sum."""

    def same(i: Ingredient, k: Ingredient) -> bool:
        return (i.place, i.index) == (k.place, k.index) and i.quantity.nearly(k.quantity)

    return len(some) == len(others) and all(any(same(i, k) for k in others) for i in some)


def _score_effect(linear: LinearModel, source: str) -> Score:
    """Score the effect of a file of effects against the model."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "found.py"
        file.write_text(source, encoding="utf-8")
        load(file)
        candidate = candidate_of(linear, EFFECTS[EFFECT_NAME])
        assert candidate is not None
        return score(linear, candidate)
