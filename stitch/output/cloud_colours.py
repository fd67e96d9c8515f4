"""Colours of the stitched cloud: how far the views' surfaces lie from it, from dark blue over green to yellow."""

import numpy as np
from numpy.typing import NDArray

from stitch.numerics.frames import Array

Colours = NDArray[np.uint8]
# Residuals from zero to that of so many points span the colours: a few large ones would make the rest one colour.
_SPAN = 0.98
# Of places that one view alone has seen.
_UNKNOWN = (150, 150, 150)


def residual_colours(residual: Array) -> tuple[Colours, float]:
    """Return colours (N, 3), bytes, of residuals (N,), and the residual at the end of the colour scale.

    The scale is viridis: dark blue at zero, yellow at the `_SPAN` quantile and beyond. A residual is NaN where a single
    view saw the point; it becomes grey. The residuals are not negative, in any unit.
    """
    from matplotlib import colormaps

    known = residual[np.isfinite(residual)]
    span = float(np.quantile(known, _SPAN)) if len(known) else 0.0
    share = np.clip(np.nan_to_num(residual) / max(span, 1e-300), 0, 1)
    colours = np.asarray(colormaps["viridis"](share)[:, :3] * 255).round().astype(np.uint8)
    colours[~np.isfinite(residual)] = _UNKNOWN
    return colours, span
