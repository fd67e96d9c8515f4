"""Pictures of the panel cell, PNG or SVG by the file's name."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch.cells.panel.errors_along import ErrorsAlong
from stitch.frames import Array


def draw_errors(
    files: Sequence[Path], names: Sequence[str], master: int, shift: ErrorsAlong, turn: ErrorsAlong
) -> None:
    """Write `errors_figure`."""
    figure = errors_figure(names, master, shift, turn)
    for file in files:
        figure.savefig(file, dpi=110)


def errors_figure(names: Sequence[str], master: int, shift: ErrorsAlong, turn: ErrorsAlong) -> Figure:
    """Error against distance and angle, one line per slave: the worst of the three axes."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.subplots(2, 2, sharex="row", squeeze=False)
    rows = ((shift, shift.steps, "distance moved / mm"), (turn, np.degrees(turn.steps), "angle turned / deg"))
    for row, (errors, steps, label) in enumerate(rows):
        _lines(axes[row, 0], steps, errors.position * 1e3, names, master, label, "position error / µm")
        _lines(axes[row, 1], steps, np.degrees(errors.angle) * 1e3, names, master, label, "angle error / 0.001°")
    axes[0, 0].legend(title=f"slaves of {names[master]}", fontsize="small")
    figure.suptitle("Slave against master, rms expected from the global model's covariance, worst axis")
    return figure


def _lines(axis: Axes, steps: Array, values: Array, names: Sequence[str], master: int, across: str, up: str) -> None:
    for i, name in enumerate(names):
        if i != master:
            axis.plot(steps, values[:, :, i].max(axis=0), label=name)
    # An error of zero shall look like zero, not like magnified rounding.
    axis.set(xlabel=across, ylabel=up, ylim=(0, max(0.05, 1.05 * values.max())))
    axis.grid(alpha=0.3)


def draw_shape(file: Path, names: Sequence[str], steps: Sequence[Array], tolerance: float, forces: Array) -> None:
    """Largest deviation at each clamp, step by step (each (N,) mm), and the largest force (steps,) N."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    table = np.array(steps)
    for i, name in enumerate(names):
        left.plot(range(len(table)), table[:, i], marker="o", label=name)
    left.axhline(tolerance, color="0.4", linestyle="--", label="tolerance")
    left.set(xlabel="corrections", ylabel="largest deviation at the clamp / mm", xticks=range(len(table)))
    left.set_ylim(0, None)
    left.legend(fontsize="small", ncols=2)
    right.bar(range(len(forces)), forces)
    right.set(xlabel="corrections", ylabel="largest change of force / N", xticks=range(len(forces)))
    figure.savefig(file, dpi=110)
