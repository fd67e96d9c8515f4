"""The error over the history of the model, as a figure."""

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from stitch.comparison.disagreement_field import effect_changes, full_colour_distance, model_history
from stitch.runs.run import LedgerStep, Run
from stitch.units import MICROMETRES, length_text
from viz.colours import BLUE, FIELD, GREEN, above, plain, unsigned_colours
from viz.part_picture import painted, visible
from viz.part_surface import camera_for, part_surface

# The error falling, in one picture: the part where the views disagree, model by model, and the residuals beside it.


def error_falling(run: Run) -> Figure:
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
    limit = full_colour_distance(history.models[0].field) * um
    count = len(history.models)
    figure = Figure(figsize=(1.9 * count + 4.0, 3.6), layout="constrained")
    parts, right = figure.subfigures(1, 2, width_ratios=[1.9 * count, 3.6])
    panels = np.atleast_1d(parts.subplots(1, count))
    for axes, step in zip(panels, history.models, strict=True):
        colours = unsigned_colours(surface.coloured(step.field.overall * um), limit)
        axes.imshow(painted(surface, camera, seen, colours))
        axes.axis("off")
        axes.set_title(f"{step.name}\n{length_text(step.field.mean_abs * um / 1e3, 'mm')} on average", fontsize=10)
    scale = ScalarMappable(Normalize(0, limit), colormaps[FIELD])
    parts.colorbar(scale, ax=panels, label="views disagree by (µm)", extend="max", shrink=0.75, aspect=30)
    _bars(right.subplots(), run, um)
    return figure


def _bars(axes: Axes, run: Run, um: float) -> None:
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


# So many steps have room for whole names of effects.
_SIDE_BY_SIDE = 4


def waterfall(ledger: tuple[LedgerStep, ...], length_unit: str) -> Figure:
    """Residual, held-out residual and noise floor over the model's history."""
    um = MICROMETRES[length_unit]
    figure = Figure(figsize=(7, 2.9), layout="constrained")
    axes = figure.subplots()
    place = np.arange(len(ledger))
    inside = axes.bar(place - 0.2, [s.residual_rms * um for s in ledger], 0.38, color=BLUE, label="in the fit")
    outside = axes.bar(place + 0.2, [s.heldout_rms * um for s in ledger], 0.38, color=GREEN, label="on views left out")
    for bars in (inside, outside):
        axes.bar_label(bars, fmt="%.1f", fontsize=8, padding=2)
    floors = np.array([s.noise_floor * um for s in ledger])
    axes.hlines(floors, place - 0.45, place + 0.45, color="k", ls="--", lw=1.2, label="noise floor of the sensor")
    changes = [effect_changes(ledger, i).replace(", ", "\n") for i in place]
    # Of many steps a name is wider than its bars.
    narrow = len(ledger) > _SIDE_BY_SIDE
    axes.set_xticks(place, [name.replace("_", "_\n") if narrow else name for name in changes], fontsize=8)
    axes.set_ylabel("rms between views (µm)")
    above(axes)
    return plain(figure)


def two_bars(a: Run, b: Run) -> Figure:
    """Residual, held-out residual and noise floor of two runs."""
    um = MICROMETRES[a.session.length_unit]
    figure = Figure(figsize=(5.2, 2.7), layout="constrained")
    axes = figure.subplots()
    for shift, values, colour, label in (
        (-0.2, [a.residual_rms, b.residual_rms], BLUE, "in the fit"),
        (0.2, [a.heldout_rms, b.heldout_rms], GREEN, "on views left out"),
    ):
        bars = axes.bar(np.arange(2) + shift, np.array(values) * um, 0.38, color=colour, label=label)
        axes.bar_label(bars, fmt="%.1f", fontsize=8, padding=2)
    floors = np.array([a.noise_floor, b.noise_floor]) * um
    axes.hlines(floors, np.arange(2) - 0.45, np.arange(2) + 0.45, color="k", ls="--", lw=1.2, label="noise floor")
    axes.set_xticks([0, 1], ["A", "B"])
    axes.set_ylabel("rms between views (µm)")
    above(axes)
    return plain(figure)
