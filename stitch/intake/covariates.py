"""Columns beside the poses, times and temperatures, as views.csv names them."""

import re
from collections.abc import Sequence

import numpy as np

from stitch.intake.layouts import Layout

_TIMES = {"time", "time_s", "timestamp", "stamp", "t", "sec", "seconds"}
# Names that views.csv keeps for itself.
_OWN = re.compile(r"view|cloud|time_s|[xyz]|q[xyzw]|j\d+_(deg|approach)")


def covariate_columns(layout: Layout, rows: Sequence[int]) -> dict[str, list[str]]:
    """Cells by name, in the order of `rows`; a time that runs backwards in it is left out."""
    out: dict[str, list[str]] = {}
    for name, values in layout.rest.items():
        plain = re.sub(r"[^\w]+", "_", name.strip().lower()).strip("_")
        picked = np.asarray(values)[list(rows)]
        if plain in _TIMES:
            if (np.diff(picked) >= 0).all():
                out["time_s"] = [f"{x:.9g}" for x in picked - picked[0]]
        elif plain and not _OWN.fullmatch(plain):
            out[plain] = [f"{x:.9g}" for x in picked]
    return out
