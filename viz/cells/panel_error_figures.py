"""Figures of what a panel cell's motions and corrections leave; PNG or SVG by the file's name."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch.cells.panel import PanelJob, PanelResult
from stitch.cells.panel_model import MotionErrors
from stitch.frames import Array
from viz.colours import BLUE, DARK, GREEN, ORANGE, YELLOW

# Lines that lie upon one another still tell by their marks; nobody has to tell red from green.
_STYLES: list[dict[str, Any]] = [
    {"color": colour, "marker": marker, "ms": 5, "mfc": "none"}
    for colour, marker in zip((BLUE, ORANGE, GREEN, YELLOW, DARK, "black"), "osD^vx", strict=True)
]


def write_pictures(job: PanelJob, result: PanelResult, folder: Path) -> list[str]:
    """Write the errors to expect along a motion as PNG and SVG; returns the files' names."""
    names = ["errors.png", "errors.svg"]
    figure = errors_figure(job.robots, job.master, result.errors.shift, result.errors.turn)
    for name in names:
        figure.savefig(folder / name, dpi=110)
    return names


def errors_figure(names: Sequence[str], master: int, shift: MotionErrors, turn: MotionErrors) -> Figure:
    """Error against distance and angle, one line per slave: the worst of the three axes."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.subplots(2, 2, sharex="row", squeeze=False)
    rows = ((shift, shift.steps, "distance moved (mm)"), (turn, np.degrees(turn.steps), "angle turned (°)"))
    for row, (errors, steps, label) in enumerate(rows):
        microns, millidegrees = errors.position * 1e3, np.degrees(errors.angle) * 1e3
        columns = ((microns, "position error (µm)"), (millidegrees, "angle error (0.001°)"))
        for ax, (sizes, size_label) in zip(axes[row], columns, strict=True):
            _draw_slaves(ax, steps, sizes, names, master=master)
            ax.set(xlabel=label, ylabel=size_label)
    axes[0, 0].legend(title=f"slaves of {names[master]}", fontsize="small")
    figure.suptitle("Slave against master, rms expected from the global model's covariance, worst axis")
    return figure


def _draw_slaves(ax: Axes, steps: Array, sizes: Array, names: Sequence[str], *, master: int) -> None:
    """Errors (3, D, N) over D steps, the worst axis of each slave."""
    for i, name in enumerate(names):
        if i != master:
            ax.plot(steps, sizes[:, :, i].max(axis=0), label=name, **_STYLES[i % len(_STYLES)])
    # An error of zero shall look like zero, not like magnified rounding.
    ax.set_ylim(0, max(0.05, 1.05 * sizes.max()))
    if np.allclose(sizes, 0.0, atol=1e-6):
        ax.text(0.5, 0.5, "none: what is only moved does not turn", transform=ax.transAxes, ha="center", color=DARK)
    ax.grid(alpha=0.3)


def shape_figure(names: Sequence[str], steps: Sequence[Array], tolerance: float, forces: Array) -> Figure:
    """Largest deviation at each clamp, step by step (each (N,) mm), and the largest force (steps,) N."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    deviations, bars = figure.subplots(1, 2)
    table = np.array(steps)
    for i, name in enumerate(names):
        deviations.plot(range(len(table)), table[:, i], label=name, **_STYLES[i % len(_STYLES)])
    deviations.axhline(tolerance, color="0.4", linestyle="--", label="tolerance")
    deviations.set(xlabel="corrections made", ylabel="largest deviation at the clamp (mm)", xticks=range(len(table)))
    deviations.set_ylim(0, None)
    deviations.legend(fontsize="small", ncols=2)
    bars.bar(range(len(forces)), forces, color=BLUE)
    bars.set(xlabel="corrections made", ylabel="largest change of force (N)", xticks=range(len(forces)))
    return figure
