"""Figures of the comparison and the diagnosis; each function returns a Figure."""

import numpy as np
from matplotlib.figure import Figure

from stitch.diagnosis.compare import Comparison, Table
from stitch.diagnosis.diagnose import Diagnosis, Suspect
from stitch.result import Step
from viz.units import to_micrometres

_BLUE, _GREEN, _GREY, _RED = "#4878a8", "#6a9955", "#8a8a8a", "#b5523b"


def waterfall(ledger: tuple[Step, ...], length_unit: str) -> Figure:
    """Residual, held-out residual and noise floor over the model's history."""
    um = to_micrometres(length_unit)
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.subplots()
    place = np.arange(len(ledger))
    axes.bar(place - 0.2, [s.residual_rms * um for s in ledger], 0.38, color=_BLUE, label="in the fit")
    axes.bar(place + 0.2, [s.heldout_rms * um for s in ledger], 0.38, color=_GREEN, label="on views left out")
    axes.plot(place, [s.noise_floor * um for s in ledger], color=_GREY, ls="--", marker="_", label="noise floor")
    axes.set_xticks(place, [_change(ledger, i) for i in place])
    axes.set_ylabel("rms between the views (µm)")
    axes.legend(frameon=False)
    return _plain(figure)


def _change(ledger: tuple[Step, ...], i: int) -> str:
    if i == 0:
        return ", ".join(ledger[0].effects) or "hand-eye alone"
    new = [f"+ {e}" for e in ledger[i].effects if e not in ledger[i - 1].effects]
    gone = [f"− {e}" for e in ledger[i - 1].effects if e not in ledger[i].effects]
    return "\n".join([*new, *gone]) or "fitted again"


def suspects(found: Diagnosis) -> Figure:
    """Log evidence of the best candidates, named ones in red."""
    shown = [s for s in found.suspects if s.ranked.score.observable][:8][::-1]
    figure = Figure(figsize=(7, 0.4 + 0.3 * max(len(shown), 1)), layout="constrained")
    axes = figure.subplots()
    colours = [_RED if s.name in found.effects else _BLUE for s in shown]
    axes.barh([s.name for s in shown], [s.ranked.score.gain for s in shown], color=colours)
    axes.axvline(0, color="k", lw=0.8)
    axes.set_xlabel('log evidence over "nothing is missing"')
    return _plain(figure)


def added_variable(found: Diagnosis, at_most: int = 3) -> Figure:
    """What the views show against what each suspect predicts, hand-eye and model taken out of both.

    Points are numbers of the pose channel in units of their scatter; a straight line through zero of slope 1
    is an effect that is there as fitted.
    """
    # Of candidates that gain nothing no amplitude was fitted.
    shown = [s for s in found.suspects if s.ranked.score.observable and s.ranked.score.p_value < 1.0][:at_most]
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.subplots(1, max(len(shown), 1), sharey=True, squeeze=False)[0]
    for ax, suspect in zip(axes, shown, strict=False):
        _added(ax, found, suspect)
    axes[0].set_ylabel("seen (sigma)")
    return _plain(figure)


def _added(ax, found: Diagnosis, suspect: Suspect) -> None:
    s = suspect.ranked.score
    predicted = found.evidence.whiten_channel(s.form.columns) @ s.values
    ax.scatter(predicted, found.evidence.white_z, s=6, color=_BLUE, alpha=0.7, lw=0)
    reach = np.array([predicted.min(), predicted.max()])
    ax.plot(reach, reach, color=_RED, lw=1)
    ax.set_title(suspect.name, fontsize=9)
    ax.set_xlabel("predicted (sigma)")


def alias_picture(found: Diagnosis, at_most: int = 12) -> Figure:
    """How much of each suspect's pattern the others can imitate."""
    keep = [k for k, s in enumerate(found.suspects) if s.ranked.score.observable][:at_most]
    names = [found.suspects[k].name for k in keep]
    figure = Figure(figsize=(6.2, 5.2), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(found.matrix[np.ix_(keep, keep)], vmin=0, vmax=1, cmap="Blues")
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
        ax.errorbar(d.bins, d.mean * um, 2 * d.sigma * um, color=_BLUE, marker="o", ms=4, lw=1, capsize=2)
        ax.axhline(0, color="k", lw=0.6)
        ax.set_title(f"p = {d.p_value:.1g}", fontsize=9)
        ax.set_xlabel(d.covariate)
    axes[0].set_ylabel("displaced (µm, ± 2 sigma)")
    return _plain(figure)


def budget(found: Diagnosis, length_unit: str) -> Figure:
    """Mean squares between the views: sensor noise, what the best suspect explains, the rest."""
    um = to_micrometres(length_unit)
    total, noise = (found.residual_rms * um) ** 2, (found.noise_floor * um) ** 2
    left = next((s.left for s in found.suspects if s.left is not None and s.name in found.effects), None)
    explained = 0.0 if left is None else max(total * (1 - left.inside), 0.0)
    parts = [("sensor noise", min(noise, total), _GREY), (", ".join(found.effects) or "explained", explained, _RED),
             ("scatter of the poses and the rest", max(total - noise - explained, 0.0), _BLUE)]  # fmt: skip
    figure = Figure(figsize=(7, 1.3), layout="constrained")
    axes = figure.subplots()
    start = 0.0
    for name, size, colour in parts:
        if size > 0:
            axes.barh([0], [size / total * 100], left=[start], color=colour, label=name)
            start += size / total * 100
    axes.set_yticks([])
    axes.set_xlabel(f"share of the mean square, {np.sqrt(total):.1f} µm rms (%)")
    axes.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return _plain(figure)


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
    return _plain(figure)


def _against(ax, table: Table, um: float) -> None:
    x = (table.low + table.high) / 2
    ax.errorbar(x, table.mean * um, 2 * table.mean_sigma * um, color=_BLUE, marker="o", ms=3, lw=1, capsize=2)
    ax.axhline(0, color="k", lw=0.6)
    ax.set_xlabel(f"{table.name}{f' ({table.unit})' if table.unit else ''}", fontsize=8)
    ax.tick_params(labelsize=7)


def view_arrows(found: Diagnosis, length_unit: str) -> Figure:
    """How far every view sits from where the model puts it."""
    um = to_micrometres(length_unit)
    moved = found.evidence.displaced() * um
    figure = Figure(figsize=(7, 2.3), layout="constrained")
    axes = figure.subplots()
    for i, (axis, colour) in enumerate(zip("xyz", (_RED, _GREEN, _BLUE), strict=True)):
        axes.plot(moved[:, i], marker="o", ms=3, lw=0.8, color=colour, label=axis)
    axes.axhline(0, color="k", lw=0.6)
    axes.set(xlabel="view", ylabel="displaced (µm)")
    axes.legend(frameon=False, ncols=3)
    return _plain(figure)


def _plain(figure: Figure) -> Figure:
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    return figure
