"""Colours that mean the same in the recording, the figures and the page."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Okabe & Ito's colours: people who do not see red and green alike can tell them apart.
BLUE, ORANGE, GREEN, YELLOW, DARK = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#707070"
# Of a few things that stand beside one another on dark and light, from the same set.
COLOURS_OF_FEW = ((86, 180, 233), (230, 159, 0), (0, 158, 115), (204, 121, 167))
# What stands beside or behind what matters.
GREY = (95, 100, 106)
# No other view sees this place, or it was not chosen: there is nothing to compare. Pages hatch it.
UNSEEN = (160, 160, 160)
# Blue–white–red: below, at and above the surface of the other views.
SIGNED = [
    "#053061",
    "#2065ab",
    "#4393c3",
    "#90c4dd",
    "#d1e5f0",
    "#f7f6f6",
    "#fddbc7",
    "#f3a481",
    "#d6604d",
    "#b1182b",
    "#67001f",
]
# Pale blue to dark red: how far the views disagree. No stop is grey, which says that nothing is known.
FIELD = ["#d3e8f0", "#f7e3a1", "#fdb24f", "#f4722b", "#cf2a1e", "#7d0a1c"]


def view_colours(count: int) -> NDArray[np.uint8]:
    """(count, 3) distinct colours, the same for the same view everywhere."""
    hues = (np.arange(count) * 0.618034) % 1.0
    wheel = np.clip(np.abs((6 * hues[:, None] + np.array([0, 4, 2])) % 6 - 3) - 1, 0, 1)
    return np.asarray(wheel * 200 + 30, np.uint8)


def signed_colours(values: Array, limit: float) -> NDArray[np.uint8]:
    """(N, 3) for signed distances; full colour at ±limit, grey where NaN."""
    return _mapped(SIGNED, 0.5 + np.asarray(values) / (2 * max(limit, 1e-12)), values)


def unsigned_colours(values: Array, limit: float) -> NDArray[np.uint8]:
    """(N, 3) for distances ≥ 0; darkest at `limit`, grey where NaN."""
    return _mapped(FIELD, np.asarray(values) / max(limit, 1e-12), values)


def _mapped(scale: list[str], share: Array, values: Array) -> NDArray[np.uint8]:
    own = np.array([[int(stop[i : i + 2], 16) for i in (1, 3, 5)] for stop in scale], float)
    place, along = np.nan_to_num(np.clip(share, 0, 1)), np.linspace(0, 1, len(own))
    colours = np.stack([np.interp(place, along, channel) for channel in own.T], axis=-1).astype(np.uint8)
    colours[~np.isfinite(values)] = UNSEEN
    return colours


def robust_limit(values: Array) -> float:
    """The 95 % quantile of |values|: a scale that single edges do not stretch."""
    seen = np.abs(values[np.isfinite(values)])
    return float(np.quantile(seen, 0.95)) if len(seen) else 1.0
