"""Columns beside the poses, times and temperatures, as views.csv names them."""

import re
from collections.abc import Sequence

import numpy as np

from stitch.frames import Array
from stitch.intake.clock_times import EPOCH_S
from stitch.intake.layouts import ColumnLayout

_TIMES = re.compile(r"(?:time|timestamp|stamp|zeit|t|sec|seconds)(?:_(s|ms|us|µs|ns|min|h))?")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
# Names that views.csv keeps for itself.
_OWN = re.compile(r"view|cloud|time_s|[xyz]|q[xyzw]|j\d+_(deg|approach)")


def covariate_columns(layout: ColumnLayout, rows: Sequence[int], time_s: Array | None = None) -> dict[str, list[str]]:
    """Cells by name, in the order of `rows`; a time that runs backwards in it and a count of the rows are left out.

    Args:
        time_s: (V,) of the clock, where the table has none in seconds.
    """
    out: dict[str, list[str]] = {}
    timed = {} if time_s is None else {"time_s": time_s}
    for name, values in (timed | layout.rest).items():
        plain = re.sub(r"[^\w]+", "_", name.strip().lower()).strip("_")
        picked = np.asarray(values)[list(rows)]
        if timing := _TIMES.fullmatch(plain):
            if (np.diff(picked) >= 0).all():
                out["time_s"] = [f"{x:.9g}" for x in (picked - picked[0]) * _seconds_per_unit(picked, timing[1])]
        elif plain and not _is_row_count(values) and not _OWN.fullmatch(plain):
            out[plain] = [f"{x:.9g}" for x in picked]
    return out


def _seconds_per_unit(times: Array, unit: str | None) -> float:
    """Seconds in one unit of a column of times: as its name says, else by the size of a time since 1970."""
    if unit is not None:
        return _SECONDS[unit]
    return next((s for s in (1.0, 1e-3, 1e-6, 1e-9) if EPOCH_S[0] < times[0] * s < EPOCH_S[1]), 1.0)


def _is_row_count(values: Array) -> bool:
    """True of the numbers 0 or 1 to the last, in any order."""
    return len(values) > 2 and bool((np.diff(np.sort(values)) == 1).all()) and values.min() in (0, 1)
