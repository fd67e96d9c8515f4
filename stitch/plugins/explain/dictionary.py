"""The columns of a formula: where in the chain something is displaced, times the quantity that it follows."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from stitch.effects.contract import TWIST, Effect, per_joint, twist
from stitch.model.model import Term, term_of
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.observations.linear_model import LinearModel
from stitch.plugins.explain.quantities import Quantity
from stitch.session.measurement import Views


@dataclass(frozen=True)
class Ingredient:
    """One addend: a place, its joint or axis, and the quantity that it is a multiple of."""

    place: str  # robot | mount | part
    index: int  # joint or axis of the twist, counted from 0
    quantity: Quantity

    @property
    def unit(self) -> str:
        """Return the unit of the coefficient, mm where it is a length."""
        own = "mm" if self.place != "robot" and self.index >= 3 else "rad"
        return f"{own}/({self.quantity.unit})" if self.quantity.unit else own

    @property
    def what(self) -> str:
        """Return what is displaced."""
        return f"q*{self.index + 1}" if self.place == "robot" else f"{self.place} {TWIST[self.index]}"


@dataclass(frozen=True)
class Dictionary:
    """All ingredients, and what the observation answers to one of each."""

    ingredients: list[Ingredient]
    places: dict[str, Array]  # (·, 6 or joints) response to the same displacement in every view
    rows: int  # of a response, in a view

    def base(self, ingredient: Ingredient) -> Array:
        """(·,) response to the same displacement in every view."""
        return self.places[ingredient.place][:, ingredient.index]

    def columns(self, ingredients: Sequence[Ingredient]) -> Array:
        """(·, k) responses to one of each, scaled."""
        values = np.stack([scaled_values(i.quantity) for i in ingredients], axis=1)
        bases = np.stack([self.base(i) for i in ingredients], axis=1)
        # Blocks beyond the views (a drawing) know nothing of them.
        factors = np.zeros((len(bases) // self.rows, len(ingredients)))
        factors[: len(values)] = values
        return bases * np.repeat(factors, self.rows, axis=0)


def build_dictionary(linear: LinearModel, factors: Sequence[Quantity]) -> Dictionary:
    """All M ingredients of these quantities.

    A joint may follow any quantity, and its own angle or direction times any other joint's angle; mount and part what
    does not turn with the arm.
    """
    joints = linear.measurement.views.joints.shape[1]
    of_arm = [Ingredient("robot", i, q) for i in range(joints) for q in _joint_quantities(i, factors)]
    elsewhere = [q for q in factors if q.kind in ("time", "course", "covariate", "torque")]
    places = [Ingredient(p, axis, q) for p in ("mount", "part") for axis, q in product(range(6), elsewhere)]
    ingredients = of_arm + places
    bases = {
        place: linear.responses([_displacement_term(linear, place)])[0].columns
        for place in {i.place for i in ingredients}
    }
    return Dictionary(ingredients, bases, linear.observation.numbers_per_view or 6)


def group_addends(ingredients: Sequence[Ingredient]) -> list[tuple[int, ...]]:
    """Return the numbers of the ingredients that come together.

    Sine and cosine of one wave do, a spring and how it stiffens, all six axes of what moves.
    """
    addends = defaultdict[tuple[str | int, ...], list[int]](list)
    for k, i in enumerate(ingredients):
        if i.place != "robot":
            addends[i.place, i.quantity.text].append(k)
            continue
        for follows in i.quantity.together or (i.quantity.text,):
            addends[i.place, follows, i.index].append(k)
    return [tuple(numbers) for numbers in addends.values()]


def _joint_quantities(i: int, factors: Sequence[Quantity]) -> list[Quantity]:
    own = [q for q in factors if q.joint == i and q.kind in ("angle", "direction")]
    others = [q for q in factors if q.joint != i and q.kind == "angle"]
    slow = [q for q in factors if q.kind in ("time", "covariate")]
    # Teeth are of a joint's own drive.
    plain = [q for q in factors if q.kind != "teeth" or q.joint == i]
    return [*plain, *(a.times(b) for a in own for b in (*others, *slow))]


def _scale(quantity: Quantity) -> float:
    """Makes columns of quantities in any unit comparable; undone in the formula."""
    return max(float(np.abs(quantity.values).max()), 1e-300)


def scaled_values(quantity: Quantity) -> Array:
    """(V,) values of at most one."""
    return quantity.values / _scale(quantity)


def coefficient(ingredient: Ingredient, of_scaled: float, length_unit: str) -> float:
    """Convert the size of a scaled column into the ingredient's unit; its lengths are in length_unit."""
    to_mm = METRES[length_unit] / METRES["mm"] if ingredient.unit.startswith("mm") else 1.0
    return to_mm * of_scaled / _scale(ingredient.quantity)


def _displacement_term(linear: LinearModel, place: str) -> Term:
    """A displacement of the same size in every view, one parameter a joint or axis."""
    if place == "robot":
        effect = Effect("each_joint", place, {"d": per_joint("rad", 1e-3, 1.0)}, _joints, ("joints",), (), "user")
    else:
        effect = Effect("each_axis", place, {"xi": twist("", 1e-3, 0.3, 1.0, 100.0)}, _twists, (), (), "user")
    return term_of(linear.measurement, effect)


def _joints(joints: Array, views: Views, d: Array) -> Array:
    """q* = q + d"""
    return joints + d


def _twists(views: Views, xi: Array) -> Array:
    """Return the same twist in every view."""
    return np.tile(xi, (views.count, 1))
