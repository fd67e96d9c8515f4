"""Checked numbers of the [robot] table: a wrong one would move the arm or its masses without a word."""

from difflib import get_close_matches
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array


def payload_of(payload: dict[str, Any] | None) -> tuple[float, Array]:
    """Mass (kg) and centre of mass (3,) in the flange frame of [robot] payload; both 0 without one."""
    if payload is None:
        return 0.0, np.zeros(3)
    known_keys("robot.payload", payload, ("mass", "com"))
    return point_mass("robot.payload", payload)


def gravity_of(gravity: Array) -> Array:
    """Gravity (3,) in m/s² in the base frame, checked."""
    return numbers("robot", {"gravity": gravity}, "gravity", (3,))


def point_mass(where: str, table: dict[str, Any]) -> tuple[float, Array]:
    """mass (kg, not negative) and com (3,) of a table; 0 where absent."""
    mass = float(numbers(where, table, "mass", ()))
    if mass < 0:
        raise InputError(f"{where}: mass is {mass:g} kg; use a positive number")
    return mass, numbers(where, table, "com", (3,))


def known_keys(where: str, table: Any, known: tuple[str, ...]) -> None:
    """Refuse other keys: a misspelt alpha_deg would silently count as 0, and the arm be another one."""
    if not isinstance(table, dict):
        raise InputError(f"{where}: {table!r} is not a table; write {{ {', '.join(k + ' = …' for k in known)} }}")
    for key in table:
        if key not in known:
            close = get_close_matches(str(key), known, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}"
            raise InputError(f"{where}: unknown key {key!r}; {hint}")


def numbers(where: str, table: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
    """The finite number, shape (), or triple, shape (3,), at `key`; 0 where absent."""
    try:
        value = np.array(table.get(key, np.zeros(shape)), float)
    except (TypeError, ValueError):
        value = np.full(shape, np.nan)
    if value.shape != shape or not np.isfinite(value).all():
        kind = "three finite numbers" if shape else "a finite number"
        raise InputError(f"{where}: {key} is {table[key]!r}; use {kind}")
    return value
