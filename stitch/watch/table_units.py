"""Units in which parameters are told in tables and drawings: those with digits before the point."""

from stitch.units import MICROMETRES, display_unit


def table_unit(unit: str, length_unit: str) -> tuple[float, str]:
    """Factor and name: lengths in µm, the rest as everywhere."""
    if unit == length_unit:
        return MICROMETRES[length_unit], "µm"
    return display_unit(unit)
