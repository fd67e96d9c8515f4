"""The part as a still picture, once for each of some steps of the model; and how the error falls beside it."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure

from stitch.numerics.frames import Array
from stitch.numerics.units import MICROMETRES, length_text
from stitch.output.comparison.disagreement_field import full_colour_distance
from stitch.output.comparison.model_history import ModelHistory, ModelStep, effect_changes
from stitch.run_data import RunData
from viz.colours import BLUE, FIELD, GREEN, unsigned_colours
from viz.figures import colormap
from viz.part_surface import Camera, PartSurface, camera_for, part_surface

# Light that comes from the eye, a little from above and from the left: so little shade that no colour turns into
# another.
_LIGHT = np.array([-0.25, 0.45, 0.86])
_AMBIENT = 0.84
# Width of one picture of the part, of the scale of colours, and of the bars beside them; inches.
_EACH, _SCALE, _BARS = 1.9, 0.9, 3.6


def part_picture(run: RunData, history: ModelHistory, steps: Sequence[ModelStep]) -> Figure:
    """Return the part once for each of some steps of the model, coloured by how far its views disagree (µm)."""
    figure = Figure(figsize=(_EACH * len(steps) + _SCALE, 3.0), layout="constrained")
    _draw_part(figure, run, history, steps)
    return figure


def error_falling(run: RunData, history: ModelHistory) -> Figure:
    """Return the part at every model of a run with effects added, and the residuals of all models beside it."""
    width = _EACH * len(history.models)
    figure = Figure(figsize=(width + _SCALE + _BARS, 3.6), layout="constrained")
    parts, right = figure.subfigures(1, 2, width_ratios=[width + _SCALE, _BARS])
    _draw_part(parts, run, history, history.models)
    _draw_bars(right.subplots(), run)
    return figure


def _draw_part(figure: Figure | SubFigure, run: RunData, history: ModelHistory, steps: Sequence[ModelStep]) -> None:
    """Draw the part once for each step into a figure, with one scale of colours."""
    um = MICROMETRES[run.session.length_unit]
    surface = part_surface(run.fused, history.patches)
    camera = camera_for(surface.vertices, surface.normals, upright=run.session.mount == "eye_in_hand")
    limit = full_colour_distance(history.models[0].field, run.session) * um
    panels = np.atleast_1d(figure.subplots(1, len(steps)))
    for axes, step in zip(panels, steps, strict=True):
        _paint(axes, surface, camera, unsigned_colours(surface.coloured(step.field.overall * um), limit) / 255)
        axes.set_title(f"{step.name}\n{length_text(step.field.mean_abs * um / 1e3, 'mm')} on average", fontsize=9)
    scale = ScalarMappable(Normalize(0, limit), colormap(FIELD))
    figure.colorbar(scale, ax=panels, label="views disagree by (µm)", extend="max", shrink=0.8, aspect=30)


def _paint(axes: Axes, surface: PartSurface, camera: Camera, colours: Array) -> None:
    """Draw a surface as a camera sees it, its triangles from the back to the front; colours (N, 3) of its vertices."""
    flat = surface.vertices @ camera.axes.T
    light = _LIGHT @ camera.axes / np.linalg.norm(_LIGHT)
    shaded = colours * (_AMBIENT + (1 - _AMBIENT) * np.clip(surface.normals @ light, 0, 1))[:, None]
    if len(surface.triangles):
        triangles = surface.triangles[np.argsort(flat[surface.triangles, 2].mean(axis=1))]
        faces = shaded[triangles].mean(axis=1)
        # Edges of the same colour leave no seams.
        drawn = PolyCollection(flat[triangles, :2], facecolors=faces, edgecolors=faces, linewidths=0.4)
        axes.add_collection(drawn)
        drawn.set_rasterized(True)
    else:
        order = np.argsort(flat[:, 2])
        axes.scatter(*flat[order, :2].T, c=shaded[order], s=1, linewidths=0)
    axes.margins(0)
    axes.set_aspect("equal")
    axes.axis("off")


def _draw_bars(axes: Axes, run: RunData) -> None:
    """Draw residual and held-out residual of every model (µm), against the noise floor."""
    um = MICROMETRES[run.session.length_unit]
    place = np.arange(len(run.ledger))
    for shift, values, colour, label in (
        (-0.2, [s.residual_rms for s in run.ledger], BLUE, "in the fit"),
        (0.2, [s.heldout_rms for s in run.ledger], GREEN, "on views left out"),
    ):
        bars = axes.bar(place + shift, np.array(values) * um, 0.38, color=colour, label=label)
        axes.bar_label(bars, fmt="%.0f", fontsize=9, padding=2)
    floor = run.ledger[-1].noise_floor * um
    axes.axhline(floor, color="k", ls="--", lw=1.2, label=f"noise of the sensor, {floor:.0f} µm")
    axes.set_xticks(place, [effect_changes(run.ledger, i) for i in place])
    axes.set_ylabel("rms between views (µm)")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9, loc="lower left", bbox_to_anchor=(0, 1.0))
