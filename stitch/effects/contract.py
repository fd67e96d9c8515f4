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

from stitch.errors import InputError
from stitch.frames import Array

PLACES = {
    "sensor": "(points (N, 3) at x*, view: ScanView, parameters) → points (N, 3) that the scanner reports",
    "robot": "(joints (V, n) reported, views: Views, parameters) → true joints (V, n)",
    "links": "(links: Links, views: Views, parameters) → Links",
    "mount": "(views: Views, parameters) → twists (V, 6): the mount is M·exp(twist)",
    "part": "(views: Views, parameters) → twists (V, 6): the part sits displaced by exp(twist), reference frame",
    "shape": "(points (N, 3) of the part in the reference frame, view: ScanView, parameters) → displaced points",
}
# Stands for all views of the session in a grid.
EVERY_VIEW = (-1.0,)
TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")
# Units are written for millimetres; a session in metres has the same unit with m.
_PER_MM = {"mm": 1.0, "m": 1e-3}
# What a link and all that it carries may well weigh, kg, where nobody states it; and how much more than is
# believable for a known mass the product of mass and compliance may be, for light and soft arms too.
_LINK_MASS, _LINK_MASS_LIMIT = 10.0, 100.0


@dataclass(frozen=True)
class Parameter:
    """One number of an effect, in a session's own unit."""

    name: str
    unit: str
    typical: float  # the size a real cell may well have; the prior's sigma
    limit: float  # beyond this nobody would believe it
    grid: tuple[float, ...] = ()  # values tried one by one: time constants, the view of an event

    @property
    def discrete(self) -> bool:
        """True for the view of an event: it is tried, never fitted."""
        return self.unit == "view"


@dataclass(frozen=True)
class Spec:
    """How an argument of the function becomes parameters."""

    kind: str  # number | offset | joint | torque | twist
    unit: str
    typical: float
    limit: float
    grid: tuple[float, ...] = ()
    unit_shift: str = ""  # of a twist's translation
    typical_shift: float = 0.0
    limit_shift: float = 0.0


def number(unit: str, typical: float, limit: float, grid: Sequence[float] = ()) -> Spec:
    """One number."""
    return Spec("number", unit, typical, limit, tuple(grid))


def offset(unit: str, typical: float, limit: float) -> Spec:
    """A vector (3,) in the reference frame that may be zero beside the effect's other parameters: c is cx, cy, cz."""
    return Spec("offset", unit, typical, limit)


def event() -> Spec:
    """The view from which on something is different; every view that can show it is tried."""
    return Spec("number", "view", 1.0, float("inf"), EVERY_VIEW)


def per_joint(unit: str, typical: float, limit: float) -> Spec:
    """An array (n,) with one number a joint: `c` becomes c1 … cn."""
    return Spec("joint", unit, typical, limit)


def per_torque(unit: str, typical: float, limit: float) -> Spec:
    """One number for each gravity torque that `Views.sag` knows: c1 … cn with masses, c2_3 … without."""
    return Spec("torque", unit, typical, limit)


def twist(
    unit: str, rotation: float, translation: float, limit_rotation: float = 0.02, limit_translation: float = 10.0
) -> Spec:
    """A twist (6,), rotation first, named rx … tz; `unit` follows rad and mm, such as "/h"."""
    return Spec("twist", f"rad{unit}", rotation, limit_rotation, (), f"mm{unit}", translation, limit_translation)


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
        """All parameters for an arm of n joints, in the session's unit."""
        out: list[Parameter] = []
        for key, spec in self.specs.items():
            if spec.kind == "twist":
                for i, name in enumerate(TWIST):
                    r = i < 3
                    sizes = (spec.typical, spec.limit) if r else (spec.typical_shift, spec.limit_shift)
                    out.append(_in_unit(name, spec.unit if r else spec.unit_shift, *sizes, (), length_unit))
            else:
                names = {"number": [key], "offset": [key + axis for axis in "xyz"],
                         "joint": [f"{key}{i + 1}" for i in range(joints)],
                         "torque": [f"{key}{name}" for name in torques]}[spec.kind]  # fmt: skip
                # A torque between two joints is that of 1 kg there: the coefficient holds the link's mass.
                for name in names:
                    massless = spec.kind == "torque" and "_" in name[len(key) :]
                    typical, limit = (_LINK_MASS, _LINK_MASS_LIMIT) if massless else (1.0, 1.0)
                    unit = f"kg {spec.unit}" if massless else spec.unit
                    out.append(_in_unit(name, unit, typical * spec.typical, limit * spec.limit, spec.grid,
                                        length_unit))  # fmt: skip
        return tuple(out)

    def arguments(self, values: Array, joints: int, torques: int) -> dict[str, Any]:
        """Keyword arguments of the function from the flat parameter vector."""
        sizes = {"number": 1, "offset": 3, "joint": joints, "torque": torques, "twist": 6}
        out, at = {}, 0
        for key, spec in self.specs.items():
            size = sizes[spec.kind]
            part = np.asarray(values[at : at + size], float)
            out[key] = float(part[0]) if spec.kind == "number" else part
            at += size
        return out


def _in_unit(
    name: str, unit: str, typical: float, limit: float, grid: tuple[float, ...], length_unit: str
) -> Parameter:
    above, _, below = unit.partition("/")
    factor = _PER_MM[length_unit] ** ((above == "mm") - (below == "mm"))
    return Parameter(name, unit.replace("mm", length_unit), typical * factor, limit * factor, grid)


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
        EFFECTS[name] = Effect(name, place, specs, function, tuple(needs), tuple(prefers), tier)
        return function

    return register
