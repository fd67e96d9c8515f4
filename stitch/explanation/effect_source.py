"""A formula as a Python file of effects that a person can read, doubt, edit and add."""

from collections.abc import Sequence

from stitch.effects.contract import TWIST
from stitch.explanation.dictionary import Ingredient
from stitch.units import METRES

_LIMIT = 10.0  # sizes: beyond that nobody would believe it


def formula_text(ingredients: Sequence[Ingredient], coefficients: Sequence[float]) -> str:
    """The formula for people: what is displaced, and by what; joint by joint, or all axes of a body at once."""
    own = list(zip(ingredients, coefficients, strict=True))
    if any(i.place != "robot" for i in ingredients):
        follows = dict.fromkeys((i.place, i.quantity.text) for i in ingredients)
        every = [[(i, c) for i, c in own if (i.place, i.quantity.text) == key] for key in follows]
        return "; ".join(_of_body(addend) for addend in every)
    targets = list(dict.fromkeys(i.what for i in ingredients))
    return "; ".join(
        f"{t} = {t.replace('*', '')} "
        + " ".join(f"{c:+.2g} {i.unit} · {i.quantity.text}" for i, c in own if i.what == t)
        for t in targets
    )


def _of_body(addend: Sequence[tuple[Ingredient, float]]) -> str:
    """part rx, ry, rz, tx, ty, tz = (+0.0003, +0.0001, 0) rad, (-0.1, 0, +0.02) mm · cos(2π t/0.2 h − 45°)"""
    units = list(dict.fromkeys(i.unit for i, _ in addend))
    sizes = [f"({', '.join(f'{c:+.2g}' for i, c in addend if i.unit == unit)}) {unit}" for unit in units]
    axes = ", ".join(TWIST[i.index] for i, _ in addend)
    first = addend[0][0]
    return f"{first.place} {axes} = {', '.join(sizes)} · {first.quantity.text}"


def _names(count: int) -> list[str]:
    """Of the sizes: a, b, … or a1, a2, … where there are more than four."""
    return list("abcd"[:count]) if count <= 4 else [f"a{k + 1}" for k in range(count)]


def effect_source(
    name: str, ingredients: Sequence[Ingredient], coefficients: Sequence[float], length_unit: str, origin: str
) -> str:
    """The file; all ingredients stand at one place.

    Args:
        coefficients: in each ingredient's unit, lengths in length_unit.
        origin: where the formula comes from, for the first line of the file.
    """
    place = ingredients[0].place
    to_mm = METRES[length_unit] / METRES["mm"]
    letters = _names(len(ingredients))
    specs = ", ".join(
        f'{a}=number("{i.unit}", typical={size:.2g}, limit={_LIMIT * size:.2g})'
        for a, i, size in (
            (a, i, abs(c) * (to_mm if i.unit.startswith("mm") else 1.0))
            for a, i, c in zip(letters, ingredients, coefficients, strict=True)
        )
    )
    told = "; ".join(f"{i.what} {a}·{i.quantity.text}" for a, i in zip(letters, ingredients, strict=True))
    arguments = ", ".join(letters)
    needs = '("joints",)' if place == "robot" else "()"
    head = (
        f'"""{origin}"""\n\nimport numpy as np\n\nfrom stitch.effects import effect, number\n\n\n'
        f'@effect("{place}", needs={needs}, {specs})\n'
    )
    if place == "robot":
        body = [f"def {name}(joints, views, {arguments}):", f'    """{told}"""', "    true = np.array(joints, float)"]
        body += [
            f"    true[:, {i.index}] += {a} * {i.quantity.code}" for a, i in zip(letters, ingredients, strict=True)
        ]
        return head + "\n".join([*body, "    return true", ""])
    body = [f"def {name}(views, {arguments}):", f'    """{told}"""', "    twist = np.zeros((views.count, 6))"]
    body += [f"    twist[:, {i.index}] += {a} * {i.quantity.code}" for a, i in zip(letters, ingredients, strict=True)]
    return head + "\n".join([*body, "    return twist", ""])
