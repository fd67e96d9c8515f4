"""Colours that mean the same in the recording, the figures and the page."""

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

# What all figures have in common.

_UNITS = (("_deg", "°"), ("_c", "°C"), ("_percent", "%"), ("_s", "s"), ("_nm", "N m"), ("_nm_per_kg", "N m/kg"))


def plain(figure: Figure) -> Figure:
    """No frame at the top and on the right."""
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def above(axes: Axes) -> None:
    """The legend above the drawing, where it covers nothing."""
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles, labels, frameon=False, ncols=len(labels), loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)


def covariate(name: str) -> str:
    """A covariate with its unit in brackets: j2_deg → j2 (°)."""
    for ending, unit in _UNITS:
        if name.endswith(ending):
            return f"{name.removesuffix(ending)} ({unit})".replace("_", " ")
    return name.replace("_", " ")


Array = NDArray[np.float64]

# Okabe & Ito's colours: people who do not see red and green alike can tell them apart.
BLUE, ORANGE, GREEN, YELLOW, DARK = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#707070"
# Of a few things that stand beside one another on dark and light, from the same set.
COLOURS_OF_FEW = ((86, 180, 233), (230, 159, 0), (0, 158, 115), (204, 121, 167))
# What stands beside or behind what matters.
GREY = (95, 100, 106)
# Grey: no other view sees this place, so there is nothing to compare.
UNSEEN = (160, 160, 160)
# Blue–white–red: below, at and above the surface of the other views.
SIGNED = "RdBu_r"
# Grey to dark red: how far the views disagree; light grey is the part itself.
FIELD = "stitch_field"
_OF_FIELD = ["#e3e6ea", "#f7e3a1", "#fdb24f", "#f4722b", "#cf2a1e", "#7d0a1c"]
if FIELD not in colormaps:
    colormaps.register(LinearSegmentedColormap.from_list(FIELD, _OF_FIELD))


def view_colours(count: int) -> NDArray[np.uint8]:
    """(count, 3) distinct colours, the same for the same view everywhere."""
    hues = (np.arange(count) * 0.618034) % 1.0
    return np.asarray(colormaps["hsv"](hues)[:, :3] * 200 + 30, np.uint8)


def signed_colours(values: Array, limit: float) -> NDArray[np.uint8]:
    """(N, 3) for signed distances; full colour at ±limit, grey where NaN."""
    return _mapped(SIGNED, 0.5 + np.asarray(values) / (2 * max(limit, 1e-12)), values)


def unsigned_colours(values: Array, limit: float) -> NDArray[np.uint8]:
    """(N, 3) for distances ≥ 0; darkest at `limit`, grey where NaN."""
    return _mapped(FIELD, np.asarray(values) / max(limit, 1e-12), values)


def _mapped(name: str, share: Array, values: Array) -> NDArray[np.uint8]:
    colours = np.asarray(colormaps[name](np.nan_to_num(np.clip(share, 0, 1)))[:, :3] * 255, np.uint8)
    colours[~np.isfinite(values)] = UNSEEN
    return colours


def robust_limit(values: Array) -> float:
    """The 95 % quantile of |values|: a scale that single edges do not stretch."""
    seen = np.abs(values[np.isfinite(values)])
    return float(np.quantile(seen, 0.95)) if len(seen) else 1.0
