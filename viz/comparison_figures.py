"""What the distance between the views follows, as a figure."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch.comparison.residual_tables import ResidualTable, ResidualTables
from stitch.units import MICROMETRES
from viz.colours import BLUE
from viz.drawing import plain


def comparison(found: ResidualTables, length_unit: str, at_most: int = 9) -> Figure:
    """Signed mean of the distance between the views against the clearest properties, with ± 2 sigma."""
    um = MICROMETRES[length_unit]
    shown = found.places[:at_most]
    rows = -(-len(shown) // 3)
    figure = Figure(figsize=(9, 2.1 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, 3, squeeze=False)).ravel()
    for ax, table in zip(axes, shown, strict=False):
        _against(ax, table, um)
    for ax in axes[len(shown) :]:
        ax.axis("off")
    for ax in axes[::3]:
        ax.set_ylabel("mean (µm)")
    return plain(figure)


def _against(ax: Axes, table: ResidualTable, um: float) -> None:
    x = (table.low + table.high) / 2
    ax.errorbar(x, table.mean * um, 2 * table.mean_sigma * um, color=BLUE, marker="o", ms=3, lw=1, capsize=2)
    ax.axhline(0, color="k", lw=0.6)
    ax.set_xlabel(f"{table.name}{f' ({table.unit})' if table.unit else ''}", fontsize=8)
    ax.tick_params(labelsize=7)
