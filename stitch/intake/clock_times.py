"""Times of day as tables have them, 09:14:13 with a date or without, as seconds; what cannot be told is said."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from stitch.frames import Array

_CLOCK = re.compile(
    r"(?:(?P<date>[\d.\-/]+)[T ]+)?"
    r"(?P<h>[01]?\d|2[0-3]):(?P<m>[0-5]\d)(?::(?P<s>[0-5]\d(?:[.,]\d+)?))?(?: ?(?P<half>[AP]M)|Z)?",
    re.IGNORECASE,
)
_YEAR_FIRST = re.compile(r"(\d{4})[-./](\d{1,2})[-./](\d{1,2})")
_YEAR_LAST = re.compile(r"(\d{1,2})([-./])(\d{1,2})\2(\d{4}|\d{2})")
DAY_S, _CENTURY = 86400.0, 2000
# Of this century, counted in seconds since 1970.
EPOCH_S = (0.9e9, 4.0e9)
DAY_FIRST, MONTH_FIRST = "dates with the day first", "dates with the month first"


@dataclass(frozen=True)
class ClockTimes:
    """A column of times of day."""

    seconds: Array | None  # (n,) since the first; None where they are left out
    words: str  # how dates were read, or why times are left out; empty where nothing is to be said
    first_s: float = 0.0  # the first since the calendar's beginning, or since midnight where no date stands beside it


def find_clock_column(labels: Sequence[tuple[str, ...]]) -> ClockTimes | None:
    """The one column of times of day among the texts beside the rows of a table; None without, or with several."""
    if len({len(texts) for texts in labels}) != 1:
        return None
    times = [t for column in zip(*labels, strict=True) if (t := clock_times(column)) is not None]
    return times[0] if len(times) == 1 else None


def clock_times(cells: Sequence[str]) -> ClockTimes | None:
    """Read a column; None where a cell is no time, or where all are the same.

    Dates whose order nobody states are read both ways. What runs backwards one way is read the other way.
    """
    both = [_column_seconds(cells, day_first) for day_first in (True, False)]
    known = [moments for moments in both if moments is not None]
    if not known or all((moments == moments[0]).all() for moments in known):
        return None
    forwards = [moments for moments in known if (np.diff(moments) >= 0).all()]
    if not forwards:
        return ClockTimes(None, "times of day run backwards and are left out; to fix: write the date beside them")
    since_first = [moments - moments[0] for moments in forwards]
    if len(forwards) == 2 and not np.array_equal(since_first[0], since_first[1]):
        return ClockTimes(
            None,
            f"times are left out, as {cells[0].strip()} may begin with the day or the month; to fix: write dates as "
            "2026-12-31",
        )
    alike = len(forwards) == 2
    words = "" if alike else DAY_FIRST if forwards[0] is both[0] else MONTH_FIRST
    return ClockTimes(np.asarray(since_first[0]), words, float(forwards[0][0]))


def _column_seconds(cells: Sequence[str], day_first: bool) -> Array | None:
    told = [_time_of_day_seconds(cell.strip(), day_first) for cell in cells]
    if not told or any(t is None for t in told):
        return None
    moments: Array = np.array(told, float)
    return moments


def _time_of_day_seconds(cell: str, day_first: bool) -> float | None:
    found = _CLOCK.fullmatch(cell)
    if not found:
        return None
    day = _date_ordinal(found["date"], day_first) if found["date"] else 0
    if day is None:
        return None
    hour = int(found["h"])
    if found["half"]:
        hour = hour % 12 + 12 * (found["half"].upper() == "PM")
    return DAY_S * day + 3600.0 * hour + 60.0 * int(found["m"]) + float((found["s"] or "0").replace(",", "."))


def _date_ordinal(text: str, day_first: bool) -> int | None:
    """Days; None where it is no date. With dots the day always stands first."""
    if found := _YEAR_FIRST.fullmatch(text):
        year, month, day = map(int, found.groups())
    elif found := _YEAR_LAST.fullmatch(text):
        first, second, year = int(found[1]), int(found[3]), int(found[4])
        year += _CENTURY * (len(found[4]) == 2)
        day, month = (first, second) if day_first or found[2] == "." else (second, first)
    else:
        return None
    try:
        return date(year, month, day).toordinal()
    except ValueError:
        return None
