"""Numbers as people read them: mm, µm below one, mrad; with the digits that are known."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

METRES = {"mm": 1e-3, "m": 1.0}  # in one length_unit
CLOUD_METRES = METRES | {"cm": 1e-2, "inch": 0.0254}  # in one unit of the files of clouds
MILLIMETRES = {"mm": 1.0, "m": 1e3}  # in one length_unit
MICROMETRES = {"mm": 1e3, "m": 1e6}  # in one length_unit


def length_power(unit: str, length: str) -> int:
    """Return the power of lengths in a unit, where `length` stands alone in it: mm, mm/h, 1/mm, but not rad/(N m)."""
    above, _, below = unit.partition("/")
    return (above.strip() == length) - (below.strip() == length)


def length_text(value: float, length_unit: str, digits: int = 3, zeros: bool = False) -> str:
    """Return a length as text in µm, from 1000 µm on in mm: 38.1 µm, 1.49 mm; a dash where it is not finite.

    Args:
        value: in `length_unit`, a key of METRES.
        digits: significant ones.
        zeros: keep those at the end, as in columns of tables.
    """
    if not np.isfinite(value):
        return "–"
    um = value * MICROMETRES[length_unit]
    # 999.7 µm would be printed as 1000.
    if abs(float(f"{um:.{digits}g}")) >= 1e3:
        return f"{_plain_decimal(um / 1e3, digits, zeros)} mm"
    return f"{_plain_decimal(um, digits, zeros)} µm"


def angle_text(value: float, digits: int = 3) -> str:
    """Return an angle in rad as text in mrad: 0.033 mrad; a dash where it is not finite."""
    return f"{_plain_decimal(value * 1e3, digits)} mrad" if np.isfinite(value) else "–"


# What the name of a covariate ends in: scanner_temperature_c, humidity_percent, j2_deg.
_ENDINGS = {"_c": "°C", "_percent": "%", "_s": "s", "_mm": "mm", "_deg": "°", "_nm": "N m", "_nm_per_kg": "N m/kg"}


def covariate_unit(name: str) -> str:
    """Return the unit that a covariate's name ends in; empty where it names none."""
    return next((unit for ending, unit in _ENDINGS.items() if name.endswith(ending)), "")


def covariate_text(name: str) -> str:
    """Return a covariate with its unit in brackets: j2_deg → j2 (°)."""
    ending = next((ending for ending in _ENDINGS if name.endswith(ending)), "")
    words = name.removesuffix(ending).replace("_", " ")
    return f"{words} ({_ENDINGS[ending]})" if ending else words


def duration_text(seconds: float) -> str:
    """Return seconds as text in s, min or h, whichever leaves a number below about a hundred."""
    size, unit = next((scale for scale in ((1, "s"), (60, "min")) if seconds < 120 * scale[0]), (3600, "h"))
    return f"{_plain_decimal(seconds / size, 2)} {unit}"


def value_uncertainty_text(value: float, U: float) -> str:
    """Return a value to the two digits of its expanded uncertainty, and that: 1451.82 ± 0.14; a dash if unknown."""
    if not np.isfinite(U) or U <= 0:
        return f"{_plain_decimal(value, 6)} ± –"
    text = uncertainty_text(U)
    return f"{value:.{len(text.partition('.')[2])}f} ± {text}"


def uncertainty_text(U: float) -> str:
    """Return an expanded uncertainty above zero as text with two digits: 0.087."""
    return _plain_decimal(U, 2, zeros=True)


def _plain_decimal(value: float, digits: int, zeros: bool = False) -> str:
    """Return a number with so many significant digits, and all digits before the point; never an exponent.

    Args:
        zeros: keep those at the end.
    """
    digits = max(digits, len(str(int(abs(value)))))
    keep = zeros and value != 0
    text = np.format_float_positional(
        value, precision=digits, fractional=False, unique=False, trim="k" if keep else "-"
    )
    return str(text).removesuffix(".")


def rounded(value: float, sigma: float) -> str:
    """Return a value rounded to the place of the first digit of its sigma; four digits where sigma is not known."""
    if not np.isfinite(sigma) or sigma <= 0:
        return f"{value:.4g}"
    place = int(np.floor(np.log10(sigma)))
    value = round(value, -place)
    return _significant_digits(value, max(int(np.floor(np.log10(abs(value)))) - place + 1, 1)) if value else "0"


def display_unit(unit: str) -> tuple[float, str]:
    """Return the factor to, and the name of, the unit in which a parameter is shown: ("rad/°C") → (1e6, "µrad/°C").

    mrad for rad, ppm for shares per °C or hour, mm for m; any other unit stays.
    """
    if unit.startswith("rad/"):
        return 1e6, f"µ{unit}"
    if unit in ("1/°C", "1/h"):
        return 1e6, f"ppm{unit[1:]}"
    if unit == "m" or unit.startswith("m/"):
        return 1e3, f"m{unit}"
    return (1e3, unit.replace("rad", "mrad")) if "rad" in unit else (1.0, unit)


class Amount(NamedTuple):
    """A parameter of an effect as people read it."""

    value: str
    sigma: str  # – where nothing is known of it
    unit: str

    def __str__(self) -> str:
        if self.unit == "view":
            return f"view {self.value}, counted from 0"
        known = "" if self.sigma == "–" else f" ± {self.sigma}"
        return f"{self.value}{known}{'' if self.unit in ('', '1') else f' {self.unit}'}"


def format_amount(value: float, sigma: float | None, unit: str) -> Amount:
    """Return a parameter as people read it, in the unit of `display_unit`: 0.63 ± 0.04 µrad/(N m), 11.5 ± 0.3 ppm/°C.

    Args:
        sigma: standard deviation; None, NaN or 0: not known.
        unit: of value and sigma, with angles in rad.
    """
    factor, shown_unit = display_unit(unit)
    known = sigma is not None and np.isfinite(sigma) and sigma > 0
    size = factor * sigma if sigma is not None and known else np.nan
    return Amount(rounded(factor * value, size), _significant_digits(size, 1) if known else "–", shown_unit)


def _significant_digits(value: float, digits: int) -> str:
    """Return a number with so many significant digits, in a form with an exponent where it is very small."""
    text = f"{value:.{digits}g}"
    return _plain_decimal(float(text), digits) if abs(value) >= 1 else text


def listed(names: Sequence[str], last: str) -> str:
    """Return names as people list them, with a word before the last one: a, b and c."""
    return f" {last} ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
