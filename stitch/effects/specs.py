"""How the arguments of an effect's function become parameters: kinds, units, plausible sizes."""

from collections.abc import Sequence
from dataclasses import dataclass

# Stands for all views of the session in a grid.
EVERY_VIEW = (-1.0,)


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
    """A vector (3,) in the reference frame, cx, cy, cz for c; it may be zero where the effect's others are not."""
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
    return Spec(
        "twist",
        f"rad{unit}",
        rotation,
        limit_rotation,
        unit_shift=f"mm{unit}",
        typical_shift=translation,
        limit_shift=limit_translation,
    )
