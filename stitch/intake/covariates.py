"""Columns beside the poses, times and temperatures, as views.csv names them."""

import re
from collections.abc import Sequence

import numpy as np

from stitch.frames import Array
from stitch.intake.layouts import Layout

_TIMES = {"time", "time_s", "timestamp", "stamp", "t", "sec", "seconds"}
# Names that views.csv keeps for itself.
_OWN = re.compile(r"view|cloud|time_s|[xyz]|q[xyzw]|j\d+_(deg|approach)")


def covariate_columns(layout: Layout, rows: Sequence[int], time_s: Array | None = None) -> dict[str, list[str]]:
    """Cells by name, in the order of `rows`; a time that runs backwards in it and a count of the rows are left out.

    Args:
        time_s: (V,) of the clock, where the table has none in seconds.
    """
    out: dict[str, list[str]] = {}
    timed = {} if time_s is None else {"time_s": time_s}
    for name, values in (timed | layout.rest).items():
        plain = re.sub(r"[^\w]+", "_", name.strip().lower()).strip("_")
        picked = np.asarray(values)[list(rows)]
        if plain in _TIMES:
            if (np.diff(picked) >= 0).all():
                out["time_s"] = [f"{x:.9g}" for x in picked - picked[0]]
        elif plain and not _counts(values) and not _OWN.fullmatch(plain):
            out[plain] = [f"{x:.9g}" for x in picked]
    return out


def _counts(values: Array) -> bool:
    """True of the numbers 0 or 1 to the last, in any order."""
    return len(values) > 2 and bool((np.diff(np.sort(values)) == 1).all()) and values.min() in (0, 1)
