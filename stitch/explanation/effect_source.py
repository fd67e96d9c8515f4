"""A formula as a Python file of effects that a person can read, doubt, edit and add."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from stitch.effects.contract import TWIST
from stitch.explanation.dictionary import Ingredient

_LIMIT = 10.0  # sizes: beyond that nobody would believe it


def formula_text(ingredients: Sequence[Ingredient], coefficients: Sequence[float]) -> str:
    """The formula for people: what is displaced, and by what; joint by joint, or all axes of a body at once.

    Args:
        coefficients: in each ingredient's unit.
    """
    if any(i.place != "robot" for i in ingredients):
        return "; ".join(map(_body_text, _by_quantity(ingredients, coefficients)))
    own = list(zip(ingredients, coefficients, strict=True))
    return "; ".join(
        f"{what} = {what.replace('*', '')} "
        + " ".join(f"{c:+.2g} {i.unit} · {i.quantity.text}" for i, c in own if i.what == what)
        for what in dict.fromkeys(i.what for i in ingredients)
    )


def _by_quantity(ingredients: Sequence[Ingredient], sizes: Sequence[Any]) -> list[list[tuple[Ingredient, Any]]]:
    """Ingredients with their sizes, those together that follow the same at one place."""
    found = defaultdict[tuple[str, str], list[tuple[Ingredient, Any]]](list)
    for i, size in zip(ingredients, sizes, strict=True):
        found[i.place, i.quantity.text].append((i, size))
    return list(found.values())


def _body_text(addend: Sequence[tuple[Ingredient, float]]) -> str:
    """part rx, ry, rz, tx, ty, tz = (+0.0003, +0.0001, 0) rad, (-0.1, 0, +0.02) mm · cos(2π t/0.2 h − 45°)"""
    units = list(dict.fromkeys(i.unit for i, _ in addend))
    sizes = [f"({', '.join(f'{c:+.2g}' for i, c in addend if i.unit == unit)}) {unit}" for unit in units]
    axes = ", ".join(TWIST[i.index] for i, _ in addend)
    first = addend[0][0]
    return f"{first.place} {axes} = {', '.join(sizes)} · {first.quantity.text}"


def _letter_names(count: int) -> list[str]:
    """Of the sizes: a, b, … or a1, a2, … where there are more than four."""
    return list("abcd"[:count]) if count <= 4 else [f"a{k + 1}" for k in range(count)]


def effect_source(name: str, ingredients: Sequence[Ingredient], coefficients: Sequence[float], origin: str) -> str:
    """The file; all ingredients stand at one place.

    Args:
        coefficients: in each ingredient's unit, as effects are written.
        origin: where the formula comes from, for the first line of the file.
    """
    place = ingredients[0].place
    letters = _letter_names(len(ingredients))
    specs = "".join(
        f'    {a}=number("{i.unit}", typical={size:.2g}, limit={_LIMIT * size:.2g}),\n'
        for a, i, size in zip(letters, ingredients, np.abs(coefficients), strict=True)
    )
    head = (
        f'"""{origin}"""\n\nimport numpy as np\n\nfrom stitch.effects import effect, number\n\n\n'
        f'@effect(\n    "{place}",\n    needs={_needed_views(ingredients)},\n{specs})\n'
    )
    body = _joint_code(ingredients, letters) if place == "robot" else _twist_code(ingredients, letters)
    first = "joints, views" if place == "robot" else "views"
    return head + "\n".join([f"def {name}({first}, {', '.join(letters)}):", *(f"    {line}" for line in body), ""])


def _needed_views(ingredients: Sequence[Ingredient]) -> str:
    """What the file's code reads of the views, as the tuple that the library asks for."""
    own = ["joints"] if ingredients[0].place == "robot" else []
    names = dict.fromkeys([*own, *(need for i in ingredients for need in i.quantity.needs)])
    quoted = [f'"{name}"' for name in names]
    return f"({quoted[0]},)" if len(quoted) == 1 else f"({', '.join(quoted)})"


def _joint_code(ingredients: Sequence[Ingredient], letters: Sequence[str]) -> list[str]:
    own = list(zip(letters, ingredients, strict=True))
    told = "; ".join(f"{i.what} {a}·{i.quantity.text}" for a, i in own)
    lines = [f"true[:, {i.index}] += {a} * {i.quantity.code}" for a, i in own]
    return [f'"""{told}"""', "true = np.array(joints, float)", *lines, "return true"]


def _twist_code(ingredients: Sequence[Ingredient], letters: Sequence[str]) -> list[str]:
    addends = _by_quantity(ingredients, letters)
    told = "; ".join(f"{own[0][0].place} ({', '.join(a for _, a in own)})·{own[0][0].quantity.text}" for own in addends)
    lines = list[str]()
    for own in addends:
        axes, sizes = [i.index for i, _ in own], ", ".join(a for _, a in own)
        lines += [f"course = {own[0][0].quantity.code}", f"twist[:, {axes}] += np.outer(course, [{sizes}])"]
    return [f'"""{told}"""', "twist = np.zeros((views.count, 6))", *lines, "return twist"]
