"""A formula in words, and as a Python file of effects that a person can read, doubt, edit and add."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from stitch.diagnosis.thresholds import FORMULA_LIMIT_SIZES
from stitch.effects.contract import TWIST
from stitch.plugins.explain.dictionary import Ingredient


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
