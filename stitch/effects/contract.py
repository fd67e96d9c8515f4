"""What an effect is: a name, parameters with units and plausible sizes, a place in the chain, a function.

    @effect("sensor", k=number("mm", typical=0.05, limit=1.0))
    def field_curvature(points, view, k):
        \"\"\"x = x* + u·k·ρ²\"\"\"
        return points + view.along(points) * (k * view.rho2(points))[:, None]

The function says what nature does; that it must be undone, its Jacobian, its test and its fit come by
themselves. What a function receives and returns depends on the place, `PLACES`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stitch.effects.specs import Spec
from stitch.errors import InputError
from stitch.units import Amount, format_amount

PLACES = {
    "sensor": "(points (N, 3) at x*, view: ScanView, parameters) → points (N, 3) that the scanner reports",
    "robot": "(joints (V, n) reported, views: Views, parameters) → true joints (V, n)",
    "links": "(links: Links, views: Views, parameters) → Links",
    "mount": "(views: Views, parameters) → twists (V, 6): the mount is M·exp(twist)",
    "part": "(views: Views, parameters) → twists (V, 6): the part sits displaced by exp(twist), reference frame",
    "shape": "(points (N, 3) of the part in the reference frame, view: ScanView, parameters) → displaced points",
}
TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")
# Units are written for millimetres; a session in metres has the same unit with m.
_PER_MM = {"mm": 1.0, "m": 1e-3}
# What a link and all that it carries may well weigh, kg, where nobody states it; and how much more than is
# believable for a known mass the product of mass and compliance may be, for light and soft arms too.
_LINK_MASS, _LINK_MASS_LIMIT = 10.0, 100.0


@dataclass(frozen=True)
class Parameter:
    """One number of an effect in a session's own unit: what is plausible, its value, and how well that is known."""

    name: str
    unit: str
    typical: float = float("nan")  # the size a real cell may well have; the prior's sigma
    limit: float = float("inf")  # beyond this something that is stated is likelier to be wrong
    grid: tuple[float, ...] = ()  # values tried one by one: time constants, the view of an event
    argument: str = ""  # of the effect's function that it is, or is a part of
    value: float = 0.0
    sigma: float = float("nan")  # NaN where the views do not show it: it is held at its value
    kept: bool = False  # of an arm that another run fitted: not fitted again
    names: tuple[str, ...] = ()  # of the session's views, where it is the number of one

    @property
    def discrete(self) -> bool:
        """True for the view of an event: it is tried, never fitted."""
        return self.unit == "view"

    @property
    def formatted(self) -> Amount:
        """As people read it; the view of an event by its name."""
        name = self.view
        return (
            Amount(name, "–", "") if name else format_amount(self.value, self.sigma if self.fitted else None, self.unit)
        )

    @property
    def view(self) -> str:
        """Name of the first view after an event; empty where it is no event."""
        number = int(np.ceil(self.value))
        return self.names[number] if 0 <= number < len(self.names) else ""

    @property
    def held(self) -> bool:
        """True if it stays at its value, even where the views could show another."""
        return bool(self.grid) or self.kept

    @property
    def fitted(self) -> bool:
        """True if views showed it, of this session or of the run that its arm comes from."""
        return bool(np.isfinite(self.sigma))

    @property
    def status(self) -> str:
        """Whether it was fitted, or why it was held."""
        if self.kept:
            return "of another run's arm, as it is"
        if self.fitted:
            return "fitted"
        return "held: the best of those tried" if self.grid else "held: these views do not show it"


@dataclass(frozen=True)
class Effect:
    """One effect of the library, of the empirical tier or of a user."""

    name: str
    place: str
    specs: dict[str, Spec]
    function: Callable[..., Any]
    needs: tuple[str, ...]  # joints, torque, velocity, intensity, or the name of a covariate
    prefers: tuple[str, ...]  # covariates used where present
    tier: str  # physical | empirical | user
    group: str = ""  # covariate that an empirical effect follows

    @property
    def formula(self) -> str:
        """The first line of the function's docstring."""
        return (self.function.__doc__ or "").strip().splitlines()[0]

    def parameters(self, joints: int, torques: Sequence[str], length_unit: str) -> tuple[Parameter, ...]:
        """All parameters for an arm of n joints at zero, in the session's unit."""
        named = [
            (key, spec, name)
            for key, spec in self.specs.items()
            for name in _parameter_names(key, spec, joints, torques)
        ]
        return tuple(_parameter(key, spec, name, length_unit) for key, spec, name in named)

    def arguments(self, parameters: Sequence[Parameter]) -> dict[str, Any]:
        """Keyword arguments of the function: a number, or an array for an argument of several parameters."""
        values: dict[str, list[float]] = {key: [] for key in self.specs}
        for p in parameters:
            values[p.argument].append(p.value)
        single = {key for key, spec in self.specs.items() if spec.kind == "number"}
        return {key: float(own[0]) if key in single else np.array(own, float) for key, own in values.items()}


def _parameter_names(key: str, spec: Spec, joints: int, torques: Sequence[str]) -> Sequence[str]:
    """Names of the parameters that an argument stands for."""
    match spec.kind:
        case "number":
            return [key]
        case "offset":
            return [key + axis for axis in "xyz"]
        case "joint":
            return [f"{key}{i + 1}" for i in range(joints)]
        case "torque":
            return [f"{key}{name}" for name in torques]
        case _:
            return TWIST


def _parameter(key: str, spec: Spec, name: str, length_unit: str) -> Parameter:
    """A parameter in the session's unit."""
    unit, typical, limit = spec.unit, spec.typical, spec.limit
    if spec.kind == "twist" and name.startswith("t"):
        unit, typical, limit = spec.unit_shift, spec.typical_shift, spec.limit_shift
    if spec.kind == "torque" and "_" in name[len(key) :]:
        # A torque between two joints is that of 1 kg there: the coefficient holds the link's mass.
        unit, typical, limit = f"kg {unit}", _LINK_MASS * typical, _LINK_MASS_LIMIT * limit
    above, _, below = unit.partition("/")
    factor = _PER_MM[length_unit] ** ((above == "mm") - (below == "mm"))
    return Parameter(name, unit.replace("mm", length_unit), typical * factor, limit * factor, spec.grid, argument=key)


EFFECTS: dict[str, Effect] = {}


def effect(
    place: str, *, needs: Sequence[str] = (), prefers: Sequence[str] = (), tier: str = "physical", **specs: Spec
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register the decorated function under its own name.

    Raises:
        InputError: unknown place, a name that is taken, or no docstring.
    """
    if place not in PLACES:
        raise InputError(f"effect at {place!r}: places are {', '.join(PLACES)}")

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        name = function.__name__
        if name in EFFECTS and EFFECTS[name].tier != "user":
            raise InputError(f"effect {name!r} is in the library already; give yours another name")
        if not (function.__doc__ or "").strip():
            raise InputError(f"effect {name!r} has no docstring; its first line says what nature does")
        EFFECTS[name] = Effect(
            name, place, specs, function=function, needs=tuple(needs), prefers=tuple(prefers), tier=tier
        )
        return function

    return register
