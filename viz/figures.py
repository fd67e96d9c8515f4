"""What all figures by matplotlib have in common: frames, legends, scales of colours, data addresses for pages."""

import base64
import io
import warnings
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.text import Text

matplotlib.use("Agg")


def subplots(width: float, height: float, *grid: int, **options: Any) -> tuple[Figure, Any]:
    """Return a figure (inches) and its axes, as `Figure.subplots` makes them; no frame at the top and on the right."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(*grid, **options)
    for ax in figure.axes:
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes


def above(axes: Axes) -> None:
    """The legend above the drawing, where it covers nothing."""
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles, labels, frameon=False, ncols=len(labels), loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)


def colormap(scale: list[str]) -> LinearSegmentedColormap:
    """Return a scale of `viz.colours` as matplotlib takes it."""
    return LinearSegmentedColormap.from_list("scale", scale)


def svg(figure: Figure) -> str:
    """A figure as a data address, drawn by lines."""
    return _address(figure, "svg", "svg+xml", metadata={"Date": None})


def png(figure: Figure, dpi: int) -> str:
    """A figure as a data address, drawn by pixels."""
    return _address(figure, "png", "png", dpi=dpi)


def save_figure(figure: Figure, file: Any, **options: Any) -> None:
    """Save a figure with names of views and columns as they are: a dollar sign begins no formula.

    Letters that no font here has become boxes, without a word.
    """
    for text in figure.findobj(Text):
        text.set_parse_math(False)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        figure.savefig(file, **options)


def _address(figure: Figure, form: str, kind: str, **options: object) -> str:
    buffer = io.BytesIO()
    save_figure(figure, buffer, format=form, **options)
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"
