"""From unknown to a formula: what a model lacks, as a sum of products of what the cell knows of its views."""

import tempfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.score import Score, score
from stitch.diagnosis.thresholds import FORMULA_LIMIT_SIZES, LARGEST_JOINT_ADDEND
from stitch.diagnosis.validation import cross_validate, extrapolate
from stitch.effects.contract import EFFECTS, TWIST
from stitch.effects.user_file import load
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.plugins.explain.dictionary import Dictionary, Ingredient, build_dictionary, coefficient
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


def formula_text(ingredients: Sequence[Ingredient], coefficients: Sequence[float]) -> str:
    """Return the formula for people: what is displaced, and by what; joint by joint, or all axes of a body at once.

    Args:
        coefficients: in each ingredient's unit.
    """
    if any(i.place != "robot" for i in ingredients):
        return "; ".join(map(_body_text, _by_quantity(ingredients, coefficients)))
    addends = list(zip(ingredients, coefficients, strict=True))
    return "; ".join(
        f"{what} = {what.replace('*', '')} "
        + " ".join(f"{c:+.2g} {i.unit} · {i.quantity.text}" for i, c in addends if i.what == what)
        for what in dict.fromkeys(i.what for i in ingredients)
    )


def _by_quantity(ingredients: Sequence[Ingredient], sizes: Sequence[Any]) -> list[list[tuple[Ingredient, Any]]]:
    """Group ingredients with their sizes: those together that follow the same at one place."""
    groups = defaultdict[tuple[str, str], list[tuple[Ingredient, Any]]](list)
    for i, size in zip(ingredients, sizes, strict=True):
        groups[i.place, i.quantity.text].append((i, size))
    return list(groups.values())


def _body_text(addend: Sequence[tuple[Ingredient, float]]) -> str:
    """part rx, ry, rz, tx, ty, tz = (+0.0003, +0.0001, 0) rad, (-0.1, 0, +0.02) mm · cos(2π t/0.2 h − 45°)"""
    units = list(dict.fromkeys(i.unit for i, _ in addend))
    sizes = [f"({', '.join(f'{c:+.2g}' for i, c in addend if i.unit == unit)}) {unit}" for unit in units]
    axes = ", ".join(TWIST[i.index] for i, _ in addend)
    first = addend[0][0]
    return f"{first.place} {axes} = {', '.join(sizes)} · {first.quantity.text}"


def effect_source(name: str, ingredients: Sequence[Ingredient], coefficients: Sequence[float], origin: str) -> str:
    """Return a Python file of one effect; all ingredients stand at one place.

    Args:
        coefficients: in each ingredient's unit, as effects are written.
        origin: where the formula comes from, for the first line of the file.
    """
    place = ingredients[0].place
    count = len(ingredients)
    letters = list("abcd"[:count]) if count <= 4 else [f"a{k + 1}" for k in range(count)]
    specs = "".join(
        f'    {a}=number("{i.unit}", typical={size:.2g}, limit={FORMULA_LIMIT_SIZES * size:.2g}),\n'
        for a, i, size in zip(letters, ingredients, np.abs(coefficients), strict=True)
    )
    # What the code reads of the views, as the tuple that the library asks for.
    names = ["joints"] if place == "robot" else []
    names = list(dict.fromkeys([*names, *(need for i in ingredients for need in i.quantity.needs)]))
    quoted = ", ".join(f'"{need}"' for need in names)
    needs = f"({quoted},)" if len(names) == 1 else f"({quoted})"
    head = (
        f'"""{origin}"""\n\nimport numpy as np\n\nfrom stitch.effects import effect, number\n\n\n'
        f'@effect(\n    "{place}",\n    needs={needs},\n{specs})\n'
    )
    body = _joint_code(ingredients, letters) if place == "robot" else _twist_code(ingredients, letters)
    first = "joints, views" if place == "robot" else "views"
    return head + "\n".join([f"def {name}({first}, {', '.join(letters)}):", *(f"    {line}" for line in body), ""])


def _joint_code(ingredients: Sequence[Ingredient], letters: Sequence[str]) -> list[str]:
    addends = list(zip(letters, ingredients, strict=True))
    formula = "; ".join(f"{i.what} {a}·{i.quantity.text}" for a, i in addends)
    lines = [f"true[:, {i.index}] += {a} * {i.quantity.code}" for a, i in addends]
    return [f'"""{formula}"""', "true = np.array(joints, float)", *lines, "return true"]


def _twist_code(ingredients: Sequence[Ingredient], letters: Sequence[str]) -> list[str]:
    formulas = list[str]()
    lines = list[str]()
    for addend in _by_quantity(ingredients, letters):
        first = addend[0][0]
        axes = [i.index for i, _ in addend]
        sizes = ", ".join(a for _, a in addend)
        formulas.append(f"{first.place} ({sizes})·{first.quantity.text}")
        lines += [f"course = {first.quantity.code}", f"twist[:, {axes}] += np.outer(course, [{sizes}])"]
    return [f'"""{"; ".join(formulas)}"""', "twist = np.zeros((views.count, 6))", *lines, "return twist"]
