"""Pictures of a scan on its CAD: the deviation map, and how all distances are spread."""

import numpy as np
from matplotlib.figure import Figure

from stitch.cells.scan_to_cad import Deviations
from stitch.cells.window import FittedPart
from viz.colours import BLUE, ORANGE, SIGNED

# An STL has no unit.
NO_UNIT = "unit of the CAD"
_MAP_POINTS = 40_000
# Inches that nine leave for the axes beside their labels and the colour bar.
_WIDE = 7.2


def deviation_map(found: Deviations, unit: str) -> Figure:
    """Points along the thinnest axis, coloured by their distance; cells beyond the tolerance ringed.

    Args:
        unit: of all lengths, `NO_UNIT` where only the CAD's file could name it.
    """
    extent = np.ptp(found.points, axis=0)
    i, j = np.sort(np.argsort(extent)[1:])
    figure = Figure(figsize=(9, min(_WIDE * extent[j] / extent[i] + 0.8, 9)), layout="constrained")
    ax = figure.subplots()
    pick = np.linspace(0, len(found.points) - 1, min(len(found.points), _MAP_POINTS)).astype(int)
    order = pick[np.argsort(np.abs(found.distance[pick]))]
    colours = {"c": found.distance[order], "cmap": SIGNED, "vmin": -found.tolerance, "vmax": found.tolerance}
    drawn = ax.scatter(found.points[order, i], found.points[order, j], s=5, lw=0, **colours)
    bad = found.cells.middle[found.outside]
    if len(bad):
        ringed = f"ringed: beyond the tolerance of ±{found.tolerance:g} {unit}"
        ax.plot(bad[:, i], bad[:, j], "o", mfc="none", mec="k", mew=0.6, ms=5, label=ringed)
        ax.legend(fontsize="small", loc="lower right")
    figure.colorbar(drawn, label=f"off the CAD, + outside ({unit})", extend="both", shrink=0.8)
    # White means no deviation, so the ground cannot be white.
    ax.set_facecolor("0.78")
    ax.set(aspect="equal", xlabel=f"{'xyz'[i]} of the part ({unit})", ylabel=f"{'xyz'[j]} of the part ({unit})")
    return figure


def histogram(part: FittedPart, unit: str) -> Figure:
    """Distances of all points, with the tolerance."""
    found = part.deviations
    figure = Figure(figsize=(7, 2.4), layout="constrained")
    ax = figure.subplots()
    reach = max(2 * found.tolerance, 1.05 * float(np.quantile(np.abs(found.distance), 0.999)))
    ax.hist(np.clip(found.distance, -reach, reach), bins=120, color=BLUE, log=True)
    for side in (-1, 1):
        ax.axvline(side * found.tolerance, color=ORANGE, ls="--", lw=1)
    ax.set(xlabel=f"distance from the CAD ({unit}; dashed: tolerance)", ylabel="points", xlim=(-reach, reach))
    ax.spines[["top", "right"]].set_visible(False)
    return figure
