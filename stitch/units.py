"""Numbers as people read them: in micrometres, with the digits that are known."""

import numpy as np

METRES = {"mm": 1e-3, "m": 1.0}  # in one length_unit
MICROMETRES = {"mm": 1e3, "m": 1e6}  # in one length_unit


def rounded(value: float, sigma: float) -> str:
    """A value to the first digit of its sigma; four digits where nothing is known of it."""
    if not np.isfinite(sigma) or sigma <= 0:
        return f"{value:.4g}"
    place = int(np.floor(np.log10(sigma)))
    value = round(value, -place)
    return f"{value:.{max(int(np.floor(np.log10(abs(value)))) - place + 1, 1)}g}" if value else "0"
