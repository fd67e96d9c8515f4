"""Which pose belongs to which scan by the clock: times in the names of the clouds against times beside the poses."""

import re
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import numpy as np

from stitch.frames import Array
from stitch.intake.clock_times import DAY_S, EPOCH_S, find_clock_column

_STAMP = re.compile(
    r"(?<!\d)(\d{4})[-_.]?(\d{2})[-_.]?(\d{2})[T_\- ]+(\d{2})[-_.h]?(\d{2})[-_.m]?(\d{2})(?:[-_.,](\d{3}|\d{6}))?(?!\d)"
)
# Seconds since 1970 with a fraction, or milli-, micro- or nanoseconds, as cameras and ROS call their files.
_SINCE_1970 = re.compile(r"(?<![\d.])(\d{10}(?:[._]\d{1,9})?|\d{13}|\d{16}|\d{19})(?![\d.])")
# Of the usual time from scan to scan: a pose farther from its scan was not taken with it.
_NEAR = 0.1


def rows_by_time(
    clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None = None
) -> tuple[list[int], float] | None:
    """Per cloud the row nearest in time, and the farthest of them, s; None where times do not tell it.

    Args:
        labels: per row the texts beside it: times of day, for clouds that have date and time in their names.
        numbers: (V, C) of the table: a column of seconds since 1970, for clouds that have these.
    """
    clock, own = find_clock_column(labels), [_calendar_seconds(cloud.stem) for cloud in clouds]
    if clock is not None and clock.seconds is not None:
        # Times of day without a date are of any day.
        dated = clock.first_s >= DAY_S
        poses = clock.first_s + clock.seconds
        return _nearest_rows(own, poses if dated else poses % DAY_S, None if dated else DAY_S)
    columns = [] if numbers is None else [t for c in numbers.T if (t := since_1970(c)) is not None]
    return (
        _nearest_rows([_unix_seconds(cloud.stem) for cloud in clouds], columns[0], None) if len(columns) == 1 else None
    )


def _nearest_rows(own: Sequence[float | None], poses: Array, day: float | None) -> tuple[list[int], float] | None:
    """Rows and the farthest of them, unless one is too far away or belongs to two."""
    if len(own) < 2 or None in own:
        return None
    scans: Array = np.array(own, float)
    away = np.abs((scans if day is None else scans % day)[:, None] - poses)
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
    try:
        days = date(int(year), int(month), int(day)).toordinal()
    except ValueError:
        return None
    clock = 3600 * int(hour) + 60 * int(minute) + int(second)
    return DAY_S * days + clock + (float(f"0.{part}") if part else 0.0)
