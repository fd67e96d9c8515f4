"""Which pose belongs to which scan by the clock: times in the names of the clouds against times beside the poses."""

import re
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import numpy as np

from stitch.frames import Array
from stitch.intake.clock_times import DAY_S, clock_of

_STAMP = re.compile(
    r"(?<!\d)(\d{4})[-_.]?(\d{2})[-_.]?(\d{2})[T_\- ]+(\d{2})[-_.h]?(\d{2})[-_.m]?(\d{2})(?:[-_.,](\d{3}|\d{6}))?(?!\d)"
)
# Of the usual time from scan to scan: a pose farther from its scan was not taken with it.
_NEAR = 0.1


def rows_by_time(clouds: Sequence[Path], labels: Sequence[tuple[str, ...]]) -> tuple[list[int], float] | None:
    """Per cloud the row nearest in time, and the farthest of them, s; None where times do not tell it."""
    clock = clock_of(labels)
    own = [_seconds(cloud.stem) for cloud in clouds]
    if clock is None or clock.seconds is None or len(own) < 2 or None in own:
        return None
    scans: Array = np.array(own, float)
    # Times of day without a date are of any day.
    dated = clock.first_s >= DAY_S
    poses = clock.first_s + clock.seconds
    away = np.abs(scans[:, None] - poses if dated else scans[:, None] % DAY_S - poses % DAY_S)
    rows = away.argmin(axis=1)
    farthest = float(away.min(axis=1).max())
    usual = float(np.median(np.diff(np.sort(scans))))
    if len(set(rows.tolist())) < len(rows) or farthest > _NEAR * usual:
        return None
    return rows.tolist(), farthest


def _seconds(name: str) -> float | None:
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
