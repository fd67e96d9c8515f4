"""Figures of the comparison and the diagnosis; each function returns a Figure."""

import numpy as np
from matplotlib.figure import Figure

from stitch.comparison.tables import Comparison, Table
from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.runs.run import Step
from viz.colours import BLUE, DARK, GREEN, ORANGE
from viz.drawing import above, covariate, plain
from viz.units import to_micrometres

# More names of views than these cannot be read along an axis.
_NAMED = 40


def waterfall(ledger: tuple[Step, ...], length_unit: str) -> Figure:
    """Residual, held-out residual and noise floor over the model's history."""
    um = to_micrometres(length_unit)
    figure = Figure(figsize=(7, 2.9), layout="constrained")
    axes = figure.subplots()
    place = np.arange(len(ledger))
    inside = axes.bar(place - 0.2, [s.residual_rms * um for s in ledger], 0.38, color=BLUE, label="in the fit")
    outside = axes.bar(place + 0.2, [s.heldout_rms * um for s in ledger], 0.38, color=GREEN, label="on views left out")
    for bars in (inside, outside):
        axes.bar_label(bars, fmt="%.1f", fontsize=8, padding=2)
    floors = np.array([s.noise_floor * um for s in ledger])
    axes.hlines(floors, place - 0.45, place + 0.45, color="k", ls="--", lw=1.2, label="noise floor of the sensor")
    axes.set_xticks(place, [change_of(ledger, i) for i in place])
    axes.set_ylabel("rms between views (µm)")
    above(axes)
    return plain(figure)


def change_of(ledger: tuple[Step, ...], i: int) -> str:
    """What step i brought or took: + joint_compliance."""
    if i == 0:
        return ", ".join(ledger[0].effects) or "hand-eye alone"
    new = [f"+ {e}" for e in ledger[i].effects if e not in ledger[i - 1].effects]
    gone = [f"− {e}" for e in ledger[i - 1].effects if e not in ledger[i].effects]
    return "\n".join([*new, *gone]) or "fitted again"


def candidates(found: Diagnosis) -> Figure:
    """Log evidence of the best candidates, named ones in red."""
    shown = [s for s in found.candidates if s.ranked.score.observable][:8][::-1]
    figure = Figure(figsize=(7, 0.4 + 0.3 * max(len(shown), 1)), layout="constrained")
    axes = figure.subplots()
    colours = [ORANGE if s.name in found.effects else BLUE for s in shown]
    axes.barh([s.name for s in shown], [s.ranked.score.gain for s in shown], color=colours)
    axes.axvline(0, color="k", lw=0.8)
    axes.set_xlabel('log evidence over "nothing is missing"')
    return plain(figure)


def added_variable(found: Diagnosis, at_most: int = 3) -> Figure:
    """What the views show against what each suspect predicts, hand-eye and model taken out of both.

    Points are numbers of the pose channel in units of their scatter; a straight line through zero of slope 1
    is an effect that is there as fitted.
    """
    # Of candidates that gain nothing no amplitude was fitted.
    shown = [s for s in found.candidates if s.ranked.score.observable and s.ranked.score.p_value < 1.0][:at_most]
    figure = Figure(figsize=(7, 3.0), layout="constrained")
    axes = figure.subplots(1, max(len(shown), 1), sharey=True, squeeze=False)[0]
    for ax, suspect in zip(axes, shown, strict=False):
        _added(ax, found, suspect)
    reach = 1.08 * max((float(np.abs(ax.dataLim.get_points()).max()) for ax in axes if shown), default=1.0)
    for ax in axes:
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), box_aspect=1)
    axes[0].set_ylabel("seen (sigma)")
    return plain(figure)


def _added(ax, found: Diagnosis, suspect: CandidateEffect) -> None:
    s = suspect.ranked.score
    predicted = found.evidence.whiten_channel(s.form.columns) @ s.values
    ax.scatter(predicted, found.evidence.white_z, s=6, color=BLUE, alpha=0.7, lw=0)
    ax.axline((0, 0), slope=1, color=ORANGE, lw=1)
    ax.set_title(f"{suspect.name}, p = {suspect.ranked.adjusted:.1g}", fontsize=9)
    ax.set_xlabel("predicted (sigma)")


def alias_picture(found: Diagnosis, at_most: int = 12) -> Figure:
    """How much of each suspect's pattern the others can imitate."""
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
    um = to_micrometres(length_unit)
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


def budget(found: Diagnosis, length_unit: str) -> Figure:
    """Mean squares between the views: sensor noise, what the best suspect explains, the rest."""
    um = to_micrometres(length_unit)
    total, noise = (found.residual_rms * um) ** 2, (found.noise_floor * um) ** 2
    left = next(
        (s.cross_validation for s in found.candidates if s.cross_validation is not None and s.name in found.effects),
        None,
    )
    explained = 0.0 if left is None else max(total * (1 - left.inside), 0.0)
    parts = [("sensor noise", min(noise, total), DARK), (", ".join(found.effects) or "explained", explained, ORANGE),
             ("scatter of the poses and the rest", max(total - noise - explained, 0.0), BLUE)]  # fmt: skip
    figure = Figure(figsize=(7, 1.3), layout="constrained")
    axes = figure.subplots()
    start = 0.0
    for name, size, colour in parts:
        if size > 0:
            axes.barh([0], [size / total * 100], left=[start], color=colour, label=name)
            start += size / total * 100
    axes.set_yticks([])
    axes.set_xlabel(f"share of the mean square, {np.sqrt(total):.1f} µm rms (%)")
    above(axes)
    return plain(figure)


def comparison(found: Comparison, length_unit: str, at_most: int = 9) -> Figure:
    """Signed mean of the distance between the views against the clearest properties, with ± 2 sigma."""
    um = to_micrometres(length_unit)
    shown = found.places[:at_most]
    rows = -(-len(shown) // 3)
    figure = Figure(figsize=(9, 2.1 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, 3, squeeze=False)).ravel()
    for ax, table in zip(axes, shown, strict=False):
        _against(ax, table, um)
    for ax in axes[len(shown) :]:
        ax.axis("off")
    for ax in axes[::3]:
        ax.set_ylabel("mean (µm)")
    return plain(figure)


def _against(ax, table: Table, um: float) -> None:
    x = (table.low + table.high) / 2
    ax.errorbar(x, table.mean * um, 2 * table.mean_sigma * um, color=BLUE, marker="o", ms=3, lw=1, capsize=2)
    ax.axhline(0, color="k", lw=0.6)
    ax.set_xlabel(f"{table.name}{f' ({table.unit})' if table.unit else ''}", fontsize=8)
    ax.tick_params(labelsize=7)


def view_arrows(found: Diagnosis, length_unit: str) -> Figure:
    """How far every view sits from where the model puts it."""
    um = to_micrometres(length_unit)
    moved = found.evidence.displaced() * um
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.subplots()
    for i, (axis, colour, marker) in enumerate(zip("xyz", (ORANGE, GREEN, BLUE), "osv", strict=True)):
        axes.plot(moved[:, i], marker=marker, ms=4, lw=0.8, color=colour, label=axis)
    axes.axhline(0, color="k", lw=0.6)
    names = [scan.name for scan in found.evidence.measurement.capture.scans]
    if 0 < len(names) <= _NAMED:
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axes.set_ylabel("displaced (µm)")
    above(axes)
    return plain(figure)
