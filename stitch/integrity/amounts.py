"""How far views are off, in words: no more than their surfaces tell, and nothing of what arms do anyway."""

import numpy as np

from stitch.observations.flange_errors import usual_twist
from stitch.units import angle_text, length_text

# That are known of a displacement.
_DIGITS = 2

# Rotation (rad) and shift (length_unit).
DisplacementSize = tuple[float, float]


def displacement_text(best: DisplacementSize, least: DisplacementSize, length_unit: str) -> str:
    """A displacement: its best estimate, or the least that is likely where surfaces hold it no better; "" for nothing
    that poses of arms do not differ by too.

    Args:
        best, least: that displacement, and the smallest one that the evidence admits.
    """
    told = _significant_displacement(best, least, length_unit)
    if told and told == _significant_displacement(least, least, length_unit):
        return told
    least_told = _significant_displacement(least, least, length_unit)
    return f"at least {least_told}" if least_told else ""


def _significant_displacement(size: DisplacementSize, least: DisplacementSize, length_unit: str) -> str:
    """What is surely more than arms repeat by."""
    angle, length = usual_twist(length_unit)[[0, 3]]
    parts = [length_text(size[1], length_unit, _DIGITS)] if least[1] > length else []
    return " and ".join([*parts, angle_in_words(size[0])] if least[0] > angle else parts)


def angle_in_words(angle: float) -> str:
    """In mrad, or in degrees where it is more than one."""
    degrees = float(np.degrees(angle))
    return f"{degrees:.{0 if degrees >= 10 else 1}f}°" if degrees > 1 else angle_text(angle, _DIGITS)
