"""From unknown to a formula: what a model lacks, as a sum of products of what the cell knows of its views."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.score import Score, score
from stitch.diagnosis.validation.cross_validation import cross_validate
from stitch.diagnosis.validation.extrapolation import extrapolate
from stitch.effects.contract import EFFECTS
from stitch.effects.user_file import load
from stitch.explanation.dictionary import Dictionary, Ingredient, build_dictionary, coefficient
from stitch.explanation.effect_source import effect_source, formula_text
from stitch.explanation.held_test import TestedSum, fitted_sizes
from stitch.explanation.quantities import view_quantities
from stitch.explanation.search import enough_views, search_sums
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.system.threads import library_threads_off

EFFECT_NAME = "explained"
# rad; no gear, spring or clearance does more to a joint. Larger addends are differences of two that look alike.
_MOST = 0.01
_TINY = 1e-12


@dataclass(frozen=True)
class Explanation:
    """A formula of which views that took no part in finding it want the like too; or none."""

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
        terms, first = build_dictionary(linear, view_quantities(linear.measurement.views)), None
        if not enough_views(linear, terms):
            return Explanation(False, _too_few_sentence(linear.measurement.views.count))
        for chosen in search_sums(linear, terms):
            tried = _try_sum(linear, terms, chosen, origin)
            if tried.found:
                return tried
            first = first or tried
            # What does not hold in the other views needs no further test.
            if not chosen.holds:
                break
        return first or Explanation(False, "Nothing that the cell knows of its views explains what is left.")


def _try_sum(linear: LinearModel, terms: Dictionary, chosen: TestedSum, origin: str) -> Explanation:
    """A sum that may hold, as an effect among all views."""
    own, scaled = chosen.ingredients, fitted_sizes(linear, terms, chosen.ingredients)
    values = _coefficients(linear, own, scaled)
    text = formula_text(own, values)
    if not chosen.holds:
        return Explanation(False, _no_formula_sentence(chosen, text))
    turns = [abs(v if i.quantity.bounded else x) for i, v, x in zip(own, values, scaled, strict=True)]
    if own[0].place == "robot" and max(turns) > _MOST:
        return Explanation(False, f"{text} would turn a joint by more than {1e3 * _MOST:.0f} mrad: no arm does that.")
    source = effect_source(EFFECT_NAME, own, values, f"{origin} {text}")
    scored = _score_effect(linear, source)
    left_out, beyond = cross_validate(linear, scored), extrapolate(linear, scored)
    share = left_out.heldout
    if not left_out.helps or share >= 1:
        return Explanation(False, f"{text} explains much, but not in views that are left out with their neighbours.")
    if beyond is not None and not beyond.helps:
        return Explanation(False, f"{beyond.rejection_reason(text)}.")
    tested = _tested_formula(linear, terms, chosen, text)
    why = f"{text}: {_test_sentence(chosen.p_value, text, tested)}."
    return Explanation(
        True, why, text, own[0].place, tested, heldout_share=share, p_value=chosen.p_value, source=source
    )


def _coefficients(linear: LinearModel, ingredients: Sequence[Ingredient], scaled: Array) -> list[float]:
    """In each ingredient's unit, of sizes (k,) of scaled columns."""
    unit = linear.measurement.length_unit
    return [coefficient(i, float(x), unit) for i, x in zip(ingredients, scaled, strict=True)]


def _tested_formula(linear: LinearModel, terms: Dictionary, chosen: TestedSum, text: str) -> str:
    """The formula that stood the test: the one that is told, or another in whose place all views want it."""
    other = chosen.instead_of
    if not other or _are_same_sum(other, chosen.ingredients):
        return text
    return formula_text(other, _coefficients(linear, other, fitted_sizes(linear, terms, other)))


def _test_sentence(p_value: float, text: str, tested: str) -> str:
    """How a formula that is told stood the test, or which one did."""
    if tested == text:
        return f"found in some of the views, it holds in the others ({_p_value_text(p_value)})"
    return (
        f"likeliest in all views, but not what was tested: {tested}, found in some of them, holds in the others "
        f"({_p_value_text(p_value)}, of this one alone)"
    )


def _are_same_sum(some: Sequence[Ingredient], others: Sequence[Ingredient]) -> bool:
    """True of what a person would call the same sum."""

    def same(i: Ingredient, k: Ingredient) -> bool:
        return (i.place, i.index) == (k.place, k.index) and i.quantity.nearly(k.quantity)

    return len(some) == len(others) and all(any(same(i, k) for k in others) for i in some)


def _p_value_text(p_value: float) -> str:
    """A p-value, as far as anybody can vouch for the tails of a distribution."""
    return f"p = {p_value:.1g}" if p_value > _TINY else f"p < {_TINY:g}"


def _no_formula_sentence(chosen: TestedSum, text: str) -> str:
    return (
        f"No formula holds: {text}, found in some of the views, is not what the others show (p = {chosen.p_value:.2g})."
    )


def _too_few_sentence(views: int) -> str:
    return (
        f"Nothing can be said from {views} views: a formula is found in some of them and tested in the others, and "
        "either are too few to tell one formula from another beside what is fitted anyway."
    )


def _score_effect(linear: LinearModel, source: str) -> Score:
    """The effect of a file of effects against the model."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "found.py"
        file.write_text(source, encoding="utf-8")
        load(file)
        candidate = candidate_of(linear, EFFECTS[EFFECT_NAME])
        assert candidate is not None
        return score(linear, candidate)
