"""Lengths as people read them."""

from stitch.units import MICROMETRES

_MILLIMETRES = {"mm": 1.0, "m": 1e3}


def to_micrometres(length_unit: str) -> float:
    """Factor from the session's unit to µm."""
    return MICROMETRES[length_unit]


def to_millimetres(length_unit: str) -> float:
    """Factor from the session's unit to mm."""
    return _MILLIMETRES[length_unit]
