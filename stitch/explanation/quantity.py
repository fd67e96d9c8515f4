"""A factor of a formula: its text, its code and its value in every view."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array

_DIGITS = 4  # of a nonlinear parameter in a formula
# What effects call that of which a quantity of a kind is made; a covariate goes by its own name.
_MADE_OF = {
    **dict.fromkeys(("angle", "gear", "teeth", "direction", "move"), "joints"),
    **dict.fromkeys(("time", "course"), "time"),
    "torque": "torque",
    "speed": "velocity",
}


@dataclass(frozen=True)
class Nonlinear:
    """A parameter of a quantity that is no factor before it: a place, a width, a period."""

    value: float
    spread: float  # by about how much the true one may lie off; as a share of it where it is positive
    positive: bool = False
    within: tuple[float, float] = (-np.inf, np.inf)

    def at(self, steps: float) -> float:
        """So many spreads off."""
        moved = self.value * np.exp(self.spread * steps) if self.positive else self.value + self.spread * steps
        return float(np.clip(moved, *self.within))

    def near(self, value: float) -> bool:
        """True of a value that is no more than a spread off."""
        steps = np.log(value / self.value) if self.positive else value - self.value
        return bool(abs(steps) <= self.spread)


@dataclass(frozen=True)
class Quantity:
    """A number a view."""

    text: str  # for people
    code: str  # of numpy, of `views`
    unit: str  # "" without one
    kind: str  # constant, angle, gear, teeth, direction, move, torque, speed, time, course or covariate
    joint: int | None  # that it belongs to, counted from 0
    values: Array  # (V,)
    together: tuple[str, ...] = ()  # addends that it is a part of, where it is not one alone
    columns: tuple[str, ...] = ()  # covariates that its code reads
    nonlinear: tuple[Nonlinear, ...] = ()
    family: "Family | None" = None  # of the nonlinear parameters' values

    @property
    def needs(self) -> tuple[str, ...]:
        """What its code reads of `views`, as effects call it."""
        made_of = [_MADE_OF[kind] for kind in self.kind.split("·") if kind in _MADE_OF]
        return tuple(dict.fromkeys([*made_of, *self.columns]))

    @property
    def slow(self) -> bool:
        """True if it follows time, or something that may move with it."""
        return any(kind in self.kind.split("·") for kind in ("time", "course", "covariate"))

    @property
    def bounded(self) -> bool:
        """True if it is one at the most, in views that nobody has measured too."""
        return set(self.kind.split("·")) <= {"constant", "angle", "gear", "teeth", "direction"}

    def times(self, other: "Quantity") -> "Quantity":
        """The product; it belongs to no joint."""
        unit = " ".join(sorted(u for u in (self.unit, other.unit) if u))
        text, code = f"{self.text}·{other.text}", f"{self.code} * {other.code}"
        kind, columns = f"{self.kind}·{other.kind}", self.columns + other.columns
        return Quantity(text, code, unit, kind, None, self.values * other.values, columns=columns)

    def moved(self, steps: Array) -> "Quantity":
        """The same with its nonlinear parameters so many spreads off."""
        return self._of([p.at(float(s)) for p, s in zip(self.nonlinear, steps, strict=True)])

    def nearly(self, other: "Quantity") -> bool:
        """True of the same, with nonlinear parameters no farther off than they may lie from the true ones."""
        own = (self.kind, self.joint, len(self.nonlinear))
        if not self.nonlinear or own != (other.kind, other.joint, len(other.nonlinear)):
            return self.text == other.text
        return all(a.near(b.value) for a, b in zip(self.nonlinear, other.nonlinear, strict=True))

    def rounded(self) -> "Quantity":
        """The same with nonlinear parameters that a person can read."""
        return self._of([float(f"{p.value:.{_DIGITS}g}") for p in self.nonlinear])

    def _of(self, parameters: list[float]) -> "Quantity":
        return self if self.family is None else self.family(*parameters)


Family = Callable[..., Quantity]
