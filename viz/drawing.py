"""What all figures have in common."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
