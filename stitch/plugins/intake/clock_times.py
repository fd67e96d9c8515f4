"""Times beside poses and in the names of scans, and which pose was taken with which scan.

Times of day stand in tables as 09:14:13, with a date or without; cameras and ROS name files by seconds since 1970.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from stitch.numerics.frames import Array

_CLOCK = re.compile(
    r"(?:(?P<date>[\d.\-/]+)[T ]+)?"
    r"(?P<h>[01]?\d|2[0-3]):(?P<m>[0-5]\d)(?::(?P<s>[0-5]\d(?:[.,]\d+)?))?(?: ?(?P<half>[AP]M)|Z)?",
    re.IGNORECASE,
)
DAY_S = 86400.0
# Of this century, counted in seconds since 1970.
EPOCH_S = (0.9e9, 4.0e9)
DAY_FIRST, MONTH_FIRST = "dates with the day first", "dates with the month first"
_STAMP = re.compile(
    r"(?<!\d)(\d{4})[-_.]?(\d{2})[-_.]?(\d{2})[T_\- ]+(\d{2})[-_.h]?(\d{2})[-_.m]?(\d{2})(?:[-_.,](\d{3}|\d{6}))?(?!\d)"
)
# Seconds since 1970 with a fraction, or milli-, micro- or nanoseconds, as cameras and ROS call their files.
_SINCE_1970 = re.compile(r"(?<![\d.])(\d{10}(?:[._]\d{1,9})?|\d{13}|\d{16}|\d{19})(?![\d.])")
# Of the usual time from scan to scan: a pose farther from its scan was not taken with it.
_NEAR = 0.1


@dataclass(frozen=True)
class ClockTimes:
    """A column of times of day."""

    seconds: Array | None  # (n,) since the first; None where they are left out
    words: str  # how dates were read, or why times are left out; empty where nothing is to be said
    first_s: float = 0.0  # the first since the calendar's beginning, or since midnight where no date stands beside it


def is_time_of_day(cell: str) -> bool:
    """True of 09:14:13, with a date before it or without."""
    return _CLOCK.fullmatch(cell.strip()) is not None


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
    known: dict[str, Array] = {}
    for words, day_first in ((DAY_FIRST, True), (MONTH_FIRST, False)):
        told = [_time_of_day_seconds(cell.strip(), day_first) for cell in cells]
        if told and None not in told:
            known[words] = np.array(told, float)
    if not known or all((moments == moments[0]).all() for moments in known.values()):
        return None
    forwards = {words: moments for words, moments in known.items() if (np.diff(moments) >= 0).all()}
    if not forwards:
        return ClockTimes(None, "times of day run backwards and are left out; to fix: write the date beside them")
    since_first = [moments - moments[0] for moments in forwards.values()]
    if len(forwards) == 2 and not np.array_equal(since_first[0], since_first[1]):
        return ClockTimes(
            None,
            f"times are left out, as {cells[0].strip()} may begin with the day or the month; to fix: write dates as "
            "2026-12-31",
        )
    words, moments = next(iter(forwards.items()))
    return ClockTimes(since_first[0], "" if len(forwards) == 2 else words, float(moments[0]))


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
    order = "%d-%m" if day_first or "." in text else "%m-%d"
    for form in ("%Y-%m-%d", f"{order}-%Y", f"{order}-%y"):
        with suppress(ValueError):
            return datetime.strptime(re.sub("[./]", "-", text), form).toordinal()
    return None


def rows_by_time(
    clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None = None
) -> tuple[list[int], float] | None:
    """Per cloud the row nearest in time, and the farthest of them, s; None where times do not tell it.

    Args:
        labels, numbers: as of `times_of_both`.
    """
    times = times_of_both(clouds, labels, numbers)
    return None if times is None else _nearest_rows(*times)


def times_of_both(
    clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None = None
) -> tuple[Array, Array, float | None] | None:
    """Return the times of clouds (N,) and rows (V,) by one calendar, s; and a day where no row bears a date.

    Args:
        labels: per row the texts beside it: times of day, for clouds that have date and time in their names.
        numbers: (V, C) of the table: a column of seconds since 1970, for clouds that have these.
    """
    clock, own = find_clock_column(labels), [_calendar_seconds(cloud.stem) for cloud in clouds]
    if clock is not None and clock.seconds is not None:
        # Times of day without a date are of any day.
        dated = clock.first_s >= DAY_S
        poses = clock.first_s + clock.seconds
        scans = np.array(own, float)
        day = None if dated else DAY_S
        return None if np.isnan(scans).any() else (scans, poses, None) if dated else (scans % DAY_S, poses % DAY_S, day)
    columns = [] if numbers is None else [t for c in numbers.T if (t := since_1970(c)) is not None]
    scans = np.array([_unix_seconds(cloud.stem) for cloud in clouds], float)
    return (scans, columns[0], None) if len(columns) == 1 and not np.isnan(scans).any() else None


def _nearest_rows(scans: Array, poses: Array, day: float | None) -> tuple[list[int], float] | None:
    """Rows and the farthest of them, unless one is too far away or belongs to two."""
    if len(scans) < 2:
        return None
    away = np.abs(scans[:, None] - poses)
    rows = away.argmin(axis=1)
    farthest = float(away.min(axis=1).max())
    usual = float(np.median(np.diff(np.sort(scans))))
    if len(set(rows.tolist())) < len(rows) or farthest > _NEAR * usual:
        return None
    return rows.tolist(), farthest


def since_1970(times: Array) -> Array | None:
    """Seconds since 1970 of a column (n,) of times of this century, in s, ms, µs or ns; None of other numbers."""
    for second in (1.0, 1e-3, 1e-6, 1e-9):
        seconds: Array = times * second
        if len(times) and EPOCH_S[0] < seconds.min() and seconds.max() < EPOCH_S[1]:
            return seconds
    return None


def _unix_seconds(name: str) -> float | None:
    """Seconds since 1970 of the one such number in a name; None where there is none, or several."""
    found = _SINCE_1970.findall(name)
    told = since_1970(np.array([float(found[0].replace("_", "."))])) if len(found) == 1 else None
    return None if told is None else float(told[0])


def _calendar_seconds(name: str) -> float | None:
    """Seconds since the calendar's beginning of the one time in a name; None where there is none, or several."""
    found = _STAMP.findall(name)
    if len(found) != 1:
        return None
    year, month, day, hour, minute, second, part = found[0]
    days = _date_ordinal(f"{year}-{month}-{day}", day_first=True)
    if days is None:
        return None
    clock = 3600 * int(hour) + 60 * int(minute) + int(second)
    return DAY_S * days + clock + (float(f"0.{part}") if part else 0.0)
