"""Units in which parameters are told in tables and drawings: those with digits before the point."""

from stitch.units import MICROMETRES


def unit_of(unit: str, length_unit: str) -> tuple[float, str]:
    """Factor and name: µm, mrad, or the unit as it is."""
    if unit == length_unit:
        return MICROMETRES[length_unit], "µm"
    return (1e3, "mrad") if unit == "rad" else (1.0, unit)
