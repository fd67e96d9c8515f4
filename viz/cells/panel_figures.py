"""Figures of a panel job; each function returns a Figure."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch import frames
from stitch.cells.panel import PanelJob, PanelResult
from stitch.frames import Array, Indices
from viz.colours import BLUE, GREEN, ORANGE, SIGNED
from viz.drawing import above


def expected_after(job: PanelJob, result: PanelResult) -> Array:
    """(K,) deviation across the surface, mm, that the commanded twists of the clamps leave at the control points."""
    assert result.shape is not None and job.control is not None
    after = np.zeros(len(job.control.clamp))
    for i, T in enumerate(result.contacts.T_panel_contact):
        beside = job.control.clamp == i
        local = frames.transform(frames.inverse(T), job.control.nominal[beside])
        twist = result.shape.twists[i]
        moved = twist[3:] + np.cross(twist[:3], local)
        after[beside] = -(result.shape.deviations[beside] @ T[:3, 2]) - moved[:, 2]
    return after


def deviation_before(job: PanelJob, result: PanelResult) -> Array:
    """(K,) deviation across the surface, mm, outwards positive: a clamp's z looks into the panel."""
    assert result.shape is not None and job.control is not None
    inward = result.contacts.T_panel_contact[job.control.clamp][:, :3, 2]
    return np.asarray(-np.einsum("ki,ki->k", result.shape.deviations, inward))


def shape(job: PanelJob, result: PanelResult) -> Figure:
    """Control points on the unrolled panel, coloured by their deviation, before and after."""
    assert job.control is not None
    figure = Figure(figsize=(10.5, 3.5), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    before = deviation_before(job, result)
    limit = max(float(np.abs(before).max()), job.tolerance)
    shown = (("measured", before), ("expected after the correction", expected_after(job, result)))
    for ax, (title, values) in zip(axes, shown, strict=True):
        _draw_panel(ax, job, result)
        at = _unrolled(job, job.control.nominal)
        drawn = ax.scatter(*at.T, c=values, s=70, cmap=SIGNED, vmin=-limit, vmax=limit, edgecolor="0.3", zorder=3)
        _write_values(ax, at, values, job.control.clamp)
        ax.set(title=f"{title}: {np.abs(values).max():.2f} mm at most", xlabel="along the panel's axis (mm)")
    axes[0].set_ylabel("around it (mm)")
    figure.colorbar(drawn, ax=axes, label="outside (+) or inside (−) its target (mm)", shrink=0.9)
    return figure


def _write_values(ax: Axes, at: Array, values: Array, clamp: Indices) -> None:
    """Each value on the side of its point that looks away from its clamp."""
    for place, value, i in zip(at, values, clamp, strict=True):
        away = np.sign(place - at[clamp == i].mean(axis=0))
        align = {"ha": "left" if away[0] > 0 else "right", "va": "center"}
        ax.annotate(_signed(value), place, xytext=7 * away * [1, 0], textcoords="offset points", fontsize=7, **align)


def _signed(value: float) -> str:
    """With its sign, which nothing has not."""
    text = f"{value:+.2f}".replace("-", "−")
    return text[1:] if text[1:] == "0.00" else text


def _draw_panel(ax: Axes, job: PanelJob, result: PanelResult) -> None:
    for name, pads in zip(job.robots, result.contacts.pads, strict=True):
        at = _unrolled(job, pads)
        ax.fill(*at.T, facecolor="0.93", edgecolor="0.6")
        aside = at.mean(axis=0) * [0.22, 1.0]
        ax.annotate(name, aside, ha="center", va="center", fontsize=13, color="0.45", weight="bold")
    half = job.layout.length / 2
    ax.set(aspect="equal", xlim=(-half - 330, half + 330))
    ax.spines[["top", "right"]].set_visible(False)


def _unrolled(job: PanelJob, points: Array) -> Array:
    """(N, 2) along the axis and around it, mm, of points (N, 3) of the panel frame."""
    R = job.layout.radius
    return np.column_stack([points[:, 0], R * np.arctan2(points[:, 1], points[:, 2] + R)])


def forces(job: PanelJob) -> Figure:
    """Size along z and across it at every clamp."""
    assert job.forces is not None
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    ax, place = figure.subplots(), np.arange(len(job.robots))
    ax.bar(place - 0.2, job.forces[:, 5], 0.38, color=BLUE, label="along z, into the panel")
    ax.bar(place + 0.2, np.linalg.norm(job.forces[:, 3:5], axis=1), 0.38, color=ORANGE, label="in its plane")
    ax.set_xticks(place, job.robots)
    ax.set(ylabel="force (N)", xlabel="clamp")
    ax.axhline(0, color="k", lw=0.6)
    ax.legend(frameon=False)
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def misfit(job: PanelJob, result: PanelResult) -> Figure:
    """Root mean square of the weighted residuals of each robot."""
    figure = Figure(figsize=(7, 2.4), layout="constrained")
    ax = figure.subplots()
    sizes = [np.sqrt(m.chi_square / m.redundancy) for m in result.models]
    ax.bar(job.robots, sizes, color=GREEN)
    ax.axhline(1.0, color="0.4", ls="--", lw=1, label="tracker's sigma")
    ax.set(ylabel="rms (sigmas)", xlabel="robot")
    above(ax)
    ax.spines[["top", "right"]].set_visible(False)
    return figure
