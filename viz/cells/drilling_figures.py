"""Figures of a drilling job; each function returns a Figure."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch.cells.drilling import DrillJob, DrillResult, Hole
from stitch.frames import Array, transform
from viz.colours import BLUE, GREEN, ORANGE

_BEFORE, _AFTER, _DRILL = ORANGE, GREEN, BLUE
# Of the panel's extent, that the largest error's arrow is drawn.
_LONGEST = 0.25
_ARROWS = {"angles": "xy", "scale_units": "xy", "scale": 1}  # as long as they are in the data's unit


def holes(job: DrillJob, result: DrillResult) -> Figure:
    """The panel from above and from its side, before and after: reference holes with error arrows, holes to drill."""
    figure = Figure(figsize=(10.5, 4.6), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=(2, 1))
    middle, along = _panel_axes(job)
    for column, title in enumerate(("by the drawing", "after the correction")):
        after = column == 1
        for row, side in enumerate((along[:2], along[[0, 2]])):
            _draw_holes(axes[row, column], job, result, middle, side, after)
            if row == 0:
                _name_holes(axes[row, column], job, middle, side)
        axes[0, column].set_title(title)
        axes[1, column].set_xlabel(f"along the panel ({job.length_unit})")
    axes[0, 0].set_ylabel(f"from above ({job.length_unit})")
    axes[1, 0].set_ylabel(f"from the side ({job.length_unit})")
    shown = {label: handle for ax in axes[0] for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    style = {"frameon": False, "fontsize": 8, "loc": "center left", "bbox_to_anchor": (1.0, 0.5)}
    axes[0, 1].legend(shown.values(), shown.keys(), **style)
    return figure


def magnified(job: DrillJob, result: DrillResult) -> float:
    """How many times larger than the panel errors are drawn: a round number."""
    places = np.array([hole.position for hole in job.holes])
    largest = max(float(np.linalg.norm(c.errors, axis=1).max()) for c in result.groups.values())
    wanted = _LONGEST * float(np.linalg.norm(np.ptp(places, axis=0))) / max(largest, 1e-12)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(max(step for step in (1, 2, 5) if step * power <= wanted) * power)


def _panel_axes(job: DrillJob) -> tuple[Array, Array]:
    """Middle (3,) of the drawing's holes and axes (3, 3): along the panel, across it, out of it."""
    places = np.array([hole.position for hole in job.holes])
    middle = places.mean(axis=0)
    return middle, np.linalg.svd(places - middle, full_matrices=False)[2]


def _draw_holes(ax: Axes, job: DrillJob, result: DrillResult, middle: Array, side: Array, after: bool) -> None:
    """One panel of `holes`; `side` (2, 3) holds the axes that are drawn."""
    colour = _AFTER if after else _BEFORE
    label = f"error {'after' if after else 'before'}, {magnified(job, result):g} times larger"
    for name, c in result.groups.items():
        references = references_of(job, name)
        nominal = np.array([hole.position for hole in references])
        at = ((transform(c.T_actual_nominal, nominal) if after else nominal) - middle) @ side.T
        off = (c.residuals if after else c.errors) @ side.T * magnified(job, result)
        ax.scatter(*at.T, s=45, facecolor="none", edgecolor="0.3", zorder=3, label=_once(ax, "reference hole"))
        ax.quiver(*at.T, *off.T, **_ARROWS, color=colour, width=0.006, label=_once(ax, label))
        ax.update_datalim(at + off)
    drives = np.array([d.position if after else d.hole.position for d in result.drives])
    ax.plot(*((drives - middle) @ side.T).T, "+", color=_DRILL, ms=9, label="hole to drill")
    ax.set_aspect("equal")
    ax.margins(0.12, 0.25)  # below and above, names and arrows have room
    ax.autoscale_view()
    ax.spines[["top", "right"]].set_visible(False)


def _name_holes(ax: Axes, job: DrillJob, middle: Array, side: Array) -> None:
    for name, position in {hole.name: hole.position for hole in job.holes}.items():
        at = side @ (position - middle)
        ax.annotate(name, at, xytext=(0, -13), textcoords="offset points", ha="center", fontsize=7, color="0.4")


def _once(ax: Axes, label: str) -> str:
    """The label for the first of several groups, nothing for the others."""
    return "_" if label in ax.get_legend_handles_labels()[1] else label


def plate(job: DrillJob, result: DrillResult) -> Figure:
    """Leave-one-out errors of the plate's holes."""
    figure = Figure(figsize=(4.6, 3.8), layout="constrained")
    ax = figure.subplots()
    at, off = job.plate_xyz[:, :2], result.leave_one_out_errors
    ax.scatter(*at.T, s=120, facecolor="none", edgecolor="0.3")
    largest = max(float(np.linalg.norm(off, axis=1).max()), 1e-9)
    scale = 0.25 * float(np.ptp(at, axis=0).max()) / largest
    ax.quiver(*at.T, *(off * scale).T, **_ARROWS, color=_BEFORE, width=0.007)
    unit = job.length_unit
    ax.set(aspect="equal", xlabel=f"flange x ({unit})", ylabel=f"flange y ({unit})")
    ax.set_title(f"longest arrow {largest:.3f} {unit}")
    ax.margins(0.25)
    return figure


def references_of(job: DrillJob, group: str) -> list[Hole]:
    """Reference holes of a group, in the order of the drawing."""
    return [hole for hole in job.holes if hole.group == group and hole.reference]
