"""Page and recording of a drilling job: where the holes are, and what the correction does to the drives' errors."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch.numerics.frames import Array, transform
from stitch.plugins.cells.drilling import (
    DrillJob,
    DrillResult,
    Drive,
    Hole,
    correction_sentence,
    significant_effect_sentences,
)
from viz.cells import stage
from viz.cells.page import Page, Picture, Table, write
from viz.colours import BLUE, GREEN, ORANGE
from viz.figures import subplots
from viz.page_parts import Row

# Figures of a drilling job; each function returns a Figure.

_BEFORE, _AFTER, _DRILL = ORANGE, GREEN, BLUE
# Of the panel's extent, that the largest error's arrow is drawn.
_LONGEST = 0.25
_ARROWS = {"angles": "xy", "scale_units": "xy", "scale": 1}  # as long as they are in the data's unit


def holes(job: DrillJob, result: DrillResult) -> Figure:
    """The panel from above and from its side, before and after: reference holes with error arrows, holes to drill."""
    figure, axes = subplots(10.5, 4.6, 2, 2, sharex=True, sharey="row", height_ratios=(2, 1))
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
    """Return the magnification of errors in the drawing: a round number."""
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


def _name_holes(ax: Axes, job: DrillJob, middle: Array, side: Array) -> None:
    for name, position in {hole.name: hole.position for hole in job.holes}.items():
        at = side @ (position - middle)
        ax.annotate(name, at, xytext=(0, -13), textcoords="offset points", ha="center", fontsize=7, color="0.4")


def _once(ax: Axes, label: str) -> str:
    """The label for the first of several groups, nothing for the others."""
    return "_" if label in ax.get_legend_handles_labels()[1] else label


def plate(job: DrillJob, result: DrillResult) -> Figure:
    """Leave-one-out errors of the plate's holes."""
    figure, ax = subplots(4.6, 3.8)
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


def write_page(job: DrillJob, result: DrillResult, path: Path) -> None:
    """Sentence, holes with error arrows before and after, plate, tables."""
    caption = (
        "Arrows: where a reference hole really is, seen from where its drive was expected to meet it, "
        f"{magnified(job, result):g} times larger. Left by the drawing; right after the correction of its group, with "
        "which the holes to drill move."
    )
    pictures = [Picture("Holes and drive errors", holes(job, result), caption)]
    if len(result.leave_one_out_errors):
        caption = "Each of the plate's holes mapped by a homography of the others: what camera and plate are worth."
        pictures.append(Picture("Hand-eye: one hole left out", plate(job, result), caption))
    words = (correction_sentence(result, job.length_unit), job.file, _about(job))
    notes = list(significant_effect_sentences(result, job.length_unit))
    write(Page("Drilling", *words, pictures, _tables(job, result), notes=notes), path)


def _about(job: DrillJob) -> list[Row]:
    references = sum(hole.reference for hole in job.holes)
    groups = len({hole.group for hole in job.holes})
    rangers = f", {len(job.rangers)} range sensors" if job.rangers else ""
    return [
        ("Measured", f"{len(job.holes)} holes in {groups} groups, {references} of them references that were seen"),
        ("Arm", "not stated"),
        ("Sensor", f"camera on the flange, by a plate of {len(job.plate_uv)} holes{rangers}"),
    ]


def _tables(job: DrillJob, result: DrillResult) -> list[Table]:
    unit = job.length_unit
    references = [
        (hole.name, name, f"{np.linalg.norm(error):.3f}", f"{np.linalg.norm(residual):.3f}")
        for name, c in result.groups.items()
        for hole, error, residual in zip(references_of(job, name), c.errors, c.residuals, strict=True)
    ]
    drives = [(d.hole.name, d.hole.group, *(f"{x:.3f}" for x in _drive_numbers(d))) for d in result.drives]
    header = ("hole", "group", *(f"{k} ({unit})" for k in "xyz"), "a (°)", "b (°)", "c (°)", f"moved ({unit})")
    return [
        Table("Reference holes", ("hole", "group", f"error before ({unit})", f"left after ({unit})"), references),
        Table("Drives", header, drives),
    ]


def _drive_numbers(d: Drive) -> list[float]:
    """Position, angles in degrees, and how far the drive moved."""
    return [*d.position, *np.degrees(d.angles), float(np.linalg.norm(d.position - d.hole.position))]


def record(job: DrillJob, result: DrillResult, path: Path) -> None:
    """Nominal, measured and corrected holes in the base frame, error arrows before and after."""
    places = np.array([hole.position for hole in job.holes])
    size = float(np.ptp(places, axis=0).max())
    with stage.stage(path, "Drilling", _words(job, result)) as recording:
        stage.points(recording, "holes/drawing", places, [stage.GREY], size / 150, [hole.name for hole in job.holes])
        for name, c in result.groups.items():
            nominal = np.array([hole.position for hole in references_of(job, name)])
            corrected, length = transform(c.T_actual_nominal, nominal), magnified(job, result)
            stage.points(recording, f"holes/measured/{name}", nominal + c.errors, [stage.BLUE], size / 150)
            args = (nominal, c.errors * length, stage.RED, size / 400)
            stage.arrows(recording, f"errors/before/{name}", *args)
            stage.arrows(recording, f"errors/after/{name}", corrected, c.residuals * length, stage.GREEN, size / 300)
        drives = np.array([d.position for d in result.drives])
        inward = np.array([d.direction for d in result.drives])
        stage.points(recording, "holes/corrected", drives, [stage.GREEN], size / 150)
        stage.arrows(recording, "drives", drives - inward * size / 8, inward * size / 8, stage.GREEN, size / 500)
        for name, placed in job.placed.items():
            stage.frame(recording, f"tool on {name}", placed.T_base_tool, size / 15)


def _words(job: DrillJob, result: DrillResult) -> str:
    notes = "\n".join(f"- {note}" for note in significant_effect_sentences(result, job.length_unit))
    return (
        f"# Drilling\n\n{correction_sentence(result, job.length_unit)}\n\n{notes}\n\nGrey: drawing. Blue: "
        "reference holes as "
        "measured. Green: corrected drives. Red and green arrows: errors before and after, "
        f"{magnified(job, result):g} times larger."
    )
