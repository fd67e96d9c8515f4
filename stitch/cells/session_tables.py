"""Columns of points.csv from labelled points, as a session of `stitch run` and `diagnose` wants them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from stitch.frames import Array
from stitch.writing.session_files import TableColumns


def points_table(views: Sequence[str], targets: Sequence[str], places: Array, sigma: Array | None) -> TableColumns:
    """Columns view, target, x, y, z and, where it is known, sigma.

    Args:
        views: N names, one for each point.
        targets: N names of what was seen there.
        places: (N, 3) in the sensor's frame.
        sigma: (N,) of each coordinate; None where nobody knows it.
    """
    columns: dict[str, Any] = {"view": list(views), "target": list(targets)}
    columns |= dict(zip("xyz", places.T, strict=True))
    return columns if sigma is None else columns | {"sigma": np.asarray(sigma, float)}
