"""Lengths as people read them."""

_MICROMETRES = {"mm": 1e3, "m": 1e6}
_MILLIMETRES = {"mm": 1.0, "m": 1e3}


def to_micrometres(length_unit: str) -> float:
    """Factor from the session's unit to µm."""
    return _MICROMETRES[length_unit]


def to_millimetres(length_unit: str) -> float:
    """Factor from the session's unit to mm."""
    return _MILLIMETRES[length_unit]
