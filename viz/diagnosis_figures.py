"""Figures of the diagnosis; each function returns a Figure."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.units import MICROMETRES
from viz.colours import BLUE, GREEN, ORANGE
from viz.drawing import above, covariate, plain

# More names of views than these cannot be read along an axis.
_NAMED = 40


def candidates(found: Diagnosis) -> Figure:
    """Log Bayes factors of the best candidate effects, named ones in orange."""
    shown = [s for s in found.candidates if s.ranked.score.observable][:8][::-1]
    figure = Figure(figsize=(7, 0.4 + 0.3 * max(len(shown), 1)), layout="constrained")
    axes = figure.subplots()
    colours = [ORANGE if s.name in found.effects else BLUE for s in shown]
    axes.barh([s.name for s in shown], [s.ranked.score.log_bayes_factor for s in shown], color=colours)
    axes.axvline(0, color="k", lw=0.8)
    axes.set_xlabel('log Bayes factor over "nothing is missing"')
    return plain(figure)


def added_variable(found: Diagnosis, at_most: int = 3) -> Figure | None:
    """What the views show against what each candidate effect predicts, hand-eye and model taken out of both.

    Points are numbers of the pose channel in units of their scatter; a straight line through zero of slope 1
    is an effect that is there as fitted. None where no candidate effect explains anything.
    """
    # Of candidates that gain nothing no amplitude was fitted.
    shown = [s for s in found.candidates if s.ranked.score.observable and s.ranked.score.p_value < 1.0][:at_most]
    if not shown:
        return None
    figure = Figure(figsize=(7, 3.0), layout="constrained")
    axes = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for ax, candidate in zip(axes, shown, strict=True):
        _added(ax, found, candidate)
    reach = 1.08 * max(float(np.abs(ax.dataLim.get_points()).max()) for ax in axes)
    for ax in axes:
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), box_aspect=1)
    axes[0].set_ylabel("seen (sigma)")
    return plain(figure)


def _added(ax: Axes, found: Diagnosis, candidate: CandidateEffect) -> None:
    s = candidate.ranked.score
    # Among what every arm may do wrong the effect itself would count as scatter.
    linear = s.base_model or found.linear
    predicted = linear.residual(s.form.columns) @ s.values
    ax.scatter(predicted, linear.white_residual, s=6, color=BLUE, alpha=0.7, lw=0)
    ax.axline((0, 0), slope=1, color=ORANGE, lw=1)
    ax.set_title(f"{candidate.name}, p = {candidate.ranked.adjusted:.1g}", fontsize=9)
    ax.set_xlabel("predicted (sigma)")


def alias_picture(found: Diagnosis, at_most: int = 12) -> Figure:
    """How much of each candidate effect's pattern the others can imitate."""
    keep = [k for k, s in enumerate(found.candidates) if s.ranked.score.observable][:at_most]
    names = [found.candidates[k].name for k in keep]
    figure = Figure(figsize=(7, 5.6), layout="constrained")
    axes = figure.subplots()
    matrix = found.matrix[np.ix_(keep, keep)]
    image = axes.imshow(matrix, vmin=0, vmax=1, cmap="Blues")
    for i, j in np.argwhere(matrix >= 0.5):
        colour = "w" if matrix[i, j] > 0.6 else "k"
        axes.text(j, i, f"{matrix[i, j]:.2f}", ha="center", va="center", fontsize=6.5, color=colour)
    axes.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=8)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_xlabel("… can be imitated by")
    axes.set_ylabel("what this effect does …")
    figure.colorbar(image, label="correlation", shrink=0.7)
    return figure


def shape(found: Diagnosis, length_unit: str, at_most: int = 3) -> Figure:
    """Unexplained displacement of the views against the covariates that they follow most."""
    um = MICROMETRES[length_unit]
    shown = found.depends_on[:at_most]
    figure = Figure(figsize=(7, 2.5), layout="constrained")
    axes = figure.subplots(1, max(len(shown), 1), sharey=True, squeeze=False)[0]
    for ax, d in zip(axes, shown, strict=False):
        ax.errorbar(d.bins, d.mean * um, 2 * d.sigma * um, color=BLUE, marker="o", ms=4, lw=1, capsize=2)
        ax.axhline(0, color="k", lw=0.6)
        ax.set_title(f"p = {d.p_value:.1g}" + ("" if d.p_value < 0.05 else ": chance"), fontsize=9)
        ax.set_xlabel(covariate(d.covariate))
    axes[0].set_ylabel("displaced (µm)")
    return plain(figure)


def view_arrows(found: Diagnosis, length_unit: str) -> Figure:
    """How far every view sits from where the model puts it."""
    um = MICROMETRES[length_unit]
    moved = found.linear.view_displacements() * um
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.subplots()
    for i, (axis, colour, marker) in enumerate(zip("xyz", (ORANGE, GREEN, BLUE), "osv", strict=True)):
        axes.plot(moved[:, i], marker=marker, ms=4, lw=0.8, color=colour, label=axis)
    axes.axhline(0, color="k", lw=0.6)
    names = [scan.name for scan in found.linear.measurement.capture.scans]
    if 0 < len(names) <= _NAMED:
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axes.set_ylabel("displaced (µm)")
    above(axes)
    return plain(figure)
