"""Times of day as tables have them, 09:14:13 with a date or without, as seconds."""

import re
from collections.abc import Sequence
from datetime import date

import numpy as np

from stitch.frames import Array

_CLOCK = re.compile(r"(?:(?P<date>[\d.\-/]+)[T ]+)?(?P<h>\d{1,2}):(?P<m>\d{2})(?::(?P<s>\d{2}(?:[.,]\d+)?))?Z?")
_YEAR_FIRST, _DAY_FIRST = (
    re.compile(r"(\d{4})[-./](\d{1,2})[-./](\d{1,2})"),
    re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})"),
)
_DAY_S = 86400.0


def seconds_of(cells: Sequence[str]) -> Array | None:
    """Seconds (n,) since the first; None where a cell is no time, or where they run backwards.

    A date that may begin with its day or its month is no time; nor are times without a date that pass midnight.
    """
    told = [_seconds(cell.strip()) for cell in cells]
    if not told or any(t is None for t in told):
        return None
    seconds = np.array(told, float)
    return None if (np.diff(seconds) < 0).any() or seconds[-1] == seconds[0] else seconds - seconds[0]


def _seconds(cell: str) -> float | None:
    found = _CLOCK.fullmatch(cell)
    if not found:
        return None
    day = 0.0
    if found["date"]:
        ordinal = _ordinal(found["date"])
        if ordinal is None:
            return None
        day = _DAY_S * ordinal
    return day + 3600.0 * int(found["h"]) + 60.0 * int(found["m"]) + float((found["s"] or "0").replace(",", "."))


def _ordinal(text: str) -> int | None:
    """Days; None where it is no date."""
    if found := _YEAR_FIRST.fullmatch(text):
        year, month, day = map(int, found.groups())
    elif found := _DAY_FIRST.fullmatch(text):
        day, month, year = map(int, found.groups())
    else:
        return None
    try:
        return date(year, month, day).toordinal()
    except ValueError:
        return None
