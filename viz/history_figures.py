"""The error over the history of the model, as a figure."""

import numpy as np
from matplotlib.figure import Figure

from stitch.comparison.disagreement_field import effect_changes
from stitch.runs.run import LedgerStep, Run
from stitch.units import MICROMETRES
from viz.colours import BLUE, GREEN
from viz.drawing import above, plain

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
