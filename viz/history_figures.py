"""The error over the history of the model, as a figure."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from stitch.numerics.units import MICROMETRES, length_text
from stitch.output.comparison.disagreement_field import full_colour_distance
from stitch.output.comparison.model_history import effect_changes, model_history
from stitch.run_data import RunData
from viz.colours import BLUE, FIELD, GREEN, unsigned_colours
from viz.figures import colormap
from viz.part_picture import painted, visible
from viz.part_surface import camera_for, part_surface

# The error falling, in one picture: the part where the views disagree, model by model, and the residuals beside it.


def error_falling(run: RunData) -> Figure:
    """The part once for every model of a run with effects added, coloured by how far its views disagree (µm).

    Raises:
        ValueError: the run has no clouds whose views overlap.
    """
    history, um = model_history(run), MICROMETRES[run.session.length_unit]
    if history is None:
        raise ValueError("views that do not overlap cannot disagree")
    surface = part_surface(run.fused, history.patches)
    camera = camera_for(surface.vertices, surface.normals, upright=run.session.mount == "eye_in_hand")
    seen = visible(surface, camera)
    limit = full_colour_distance(history.models[0].field, run.session) * um
    count = len(history.models)
    figure = Figure(figsize=(1.9 * count + 4.0, 3.6), layout="constrained")
    parts, right = figure.subfigures(1, 2, width_ratios=[1.9 * count, 3.6])
    panels = np.atleast_1d(parts.subplots(1, count))
    for axes, step in zip(panels, history.models, strict=True):
        colours = unsigned_colours(surface.coloured(step.field.overall * um), limit)
        axes.imshow(painted(surface, camera, seen, colours))
        axes.axis("off")
        axes.set_title(f"{step.name}\n{length_text(step.field.mean_abs * um / 1e3, 'mm')} on average", fontsize=10)
    scale = ScalarMappable(Normalize(0, limit), colormap(FIELD))
    parts.colorbar(scale, ax=panels, label="views disagree by (µm)", extend="max", shrink=0.75, aspect=30)
    _bars(right.subplots(), run, um)
    return figure


def _bars(axes: Axes, run: RunData, um: float) -> None:
    """Residual and held-out residual of every model, against the noise floor."""
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
