"""DH rows, payload and gravity of the [robot] table, checked: a wrong number would move the arm without a word."""

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.robot import Robot, elementary
from stitch.reading.text_file import shortened
from stitch.units import METRES

# No length, angle or mass of an arm is larger in any unit; beyond, squares overflow.
LARGEST = 1e12
_DH_KEYS = ("a", "alpha_deg", "d", "theta_deg", "mass", "com")


def robot_from_dh(
    name: str,
    convention: str,
    joints: Sequence[dict[str, Any]],
    payload: dict[str, Any] | None,
    gravity: Array,
    length_unit: str,
) -> Robot:
    """A robot from DH rows with keys a, alpha_deg, d, theta_deg, mass, com (missing ones are 0).

    Raises:
        InputError: unknown convention or key, no row, or a value that is not a finite number.
    """
    if not isinstance(joints, list) or not joints:
        raise InputError("robot.joints is no list of rows; write one DH row a joint")
    rows = [(f"robot.joints, joint {i + 1}", row) for i, row in enumerate(joints)]
    for where, row in rows:
        require_known_keys(where, row, _DH_KEYS)
    a, alpha, d, theta = (
        np.array([float(table_numbers(where, row, key, ())) for where, row in rows])
        for key in ("a", "alpha_deg", "d", "theta_deg")
    )
    alpha, theta = np.radians(alpha), np.radians(theta)
    before, after = _joint_transforms(convention, a, alpha, d)
    masses = [point_mass(where, row) for where, row in rows]
    payload_mass, payload_com = payload_of(payload)
    return Robot(
        name=name,
        convention=convention,
        before=before,
        after=after,
        theta=theta,
        mass=np.array([m for m, _ in masses]),
        com=np.array([c for _, c in masses]),
        payload_mass=payload_mass,
        payload_com=payload_com,
        gravity=gravity_of(gravity),
        metres_per_unit=METRES[length_unit],
        a=a,
        alpha=alpha,
        d=d,
    )


def _joint_transforms(convention: str, a: Array, alpha: Array, d: Array) -> tuple[Array, Array]:
    """(n, 4, 4) each: what stands before and behind the turn of every joint."""
    if convention == "standard":
        return np.broadcast_to(np.eye(4), (len(a), 4, 4)), elementary("z", 0, d) @ elementary("x", alpha, a)
    if convention == "modified":
        return elementary("x", alpha, a), elementary("z", 0, d)
    raise InputError(f'robot.dh is {convention!r}; use "standard" or "modified"')


def payload_of(payload: dict[str, Any] | None) -> tuple[float, Array]:
    """Mass (kg) and centre of mass (3,) in the flange frame of [robot] payload; both 0 without one."""
    if payload is None:
        return 0.0, np.zeros(3)
    require_known_keys("robot.payload", payload, ("mass", "com"))
    return point_mass("robot.payload", payload)


def gravity_of(gravity: Array) -> Array:
    """Gravity (3,) in m/s² in the base frame, checked."""
    return table_numbers("robot", {"gravity": gravity}, "gravity", (3,))


def point_mass(where: str, table: dict[str, Any]) -> tuple[float, Array]:
    """mass (kg, not negative) and com (3,) of a table; 0 where absent."""
    mass = float(table_numbers(where, table, "mass", ()))
    if mass < 0:
        raise InputError(f"{where}: mass is {mass:g} kg; use a positive number")
    return mass, table_numbers(where, table, "com", (3,))


def require_known_keys(where: str, table: Any, known: tuple[str, ...]) -> None:
    """Refuse other keys: a misspelt alpha_deg would silently count as 0, and the arm be another one."""
    if not isinstance(table, dict):
        raise InputError(
            f"{where}: {shortened(table)} is not a table; write {{ {', '.join(k + ' = …' for k in known)} }}"
        )
    for key in table:
        if key not in known:
            close = get_close_matches(str(key), known, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}"
            raise InputError(f"{where}: unknown key {shortened(key)}; {hint}")


def table_numbers(where: str, table: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
    """The finite number, shape (), or triple, shape (3,), at `key`; 0 where absent."""
    try:
        value = np.array(table.get(key, np.zeros(shape)), float)
    except (TypeError, ValueError, OverflowError):
        value = np.full(shape, np.nan)
    if value.shape != shape or not (np.abs(value) < LARGEST).all():
        kind = "three finite numbers" if shape else "a finite number"
        raise InputError(f"{where}: {key} is {shortened(table[key])}; use {kind}")
    return value
