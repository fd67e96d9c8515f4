"""Figures of the report, by matplotlib; each function returns a Figure."""

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib.figure import Figure

from stitch.frames import Array, transform
from stitch.result import Run
from viz.colours import SIGNED, robust_limit
from viz.recording import view_shifts
from viz.units import to_micrometres

_MAP_POINTS = 25_000


def convergence(run: Run) -> Figure:
    """Rms of the overlaps at every iteration of correct and register."""
    figure = Figure(figsize=(7, 2.8), layout="constrained")
    axes = figure.subplots()
    um, start = to_micrometres(run.session.length_unit), 0
    for stage, history in run.convergence.items():
        axes.plot(np.arange(start, start + len(history)), np.array(history) * um, marker=".", label=stage)
        start += len(history)
    axes.axhline(run.noise_floor * um, color="grey", lw=1, ls="--", label="noise floor")
    axes.set(yscale="log", xlabel="iteration", ylabel="rms of the overlaps (µm)")
    axes.legend(frameon=False)
    return _plain(figure)


def per_view(run: Run) -> Figure:
    """What register moved each view by, and what is left of it."""
    figure = Figure(figsize=(7, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    um = to_micrometres(run.session.length_unit)
    names = [view.name for view in run.session.views]
    left.bar(names, np.linalg.norm(view_shifts(run), axis=1) * um, color="#4878a8")
    left.set_ylabel("moved by register (µm)")
    right.bar(names, run.view_rms * um, color="#6a9955")
    right.axhline(run.noise_floor * um, color="grey", lw=1, ls="--")
    right.set_ylabel("rms afterwards (µm)")
    for axes in (left, right):
        axes.tick_params(axis="x", rotation=90, labelsize=7)
    return _plain(figure)


def residual_maps(run: Run) -> Figure:
    """Signed steps between the views before and after register."""
    return _maps(run, (run.poses_model, run.poses), ("under the model", "after register"))


def change_maps(run: Run) -> Figure:
    """Signed steps between the views under the model before its last change and under the present one."""
    before = run.poses_model if run.poses_before is None else run.poses_before
    return _maps(run, (before, run.poses_model), ("before the change", "after the change"))


def _maps(run: Run, poses: tuple[Array, Array], titles: tuple[str, str]) -> Figure:
    """Two maps side by side with one scale, seen along the part's thinnest axis."""
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    um = to_micrometres(run.session.length_unit)
    states = [_steps(run, p) for p in poses]
    frame = np.linalg.svd(states[1][0] - states[1][0].mean(axis=0), full_matrices=False)[2]
    limit = robust_limit(states[0][1]) * um
    for axes, (points, values), title in zip(panels, states, titles, strict=True):
        flat = (points - states[1][0].mean(axis=0)) @ frame.T
        order = np.argsort(flat[:, 2])
        drawn = axes.scatter(
            flat[order, 0], flat[order, 1], c=values[order] * um, s=1.5, cmap=SIGNED, vmin=-limit, vmax=limit, lw=0
        )
        axes.set(title=title, aspect="equal", xlabel=f"{run.session.length_unit}")
    figure.colorbar(drawn, ax=panels, label="distance between views (µm)", shrink=0.8)
    return _plain(figure)


def _steps(run: Run, poses: Array) -> tuple[Array, Array]:
    """Correspondences' midpoints and signed distances under the given poses."""
    middles, values = [], []
    clouds = [view.cloud.points for view in run.session.views if view.cloud]
    for m in run.overlaps.matches:
        p = transform(poses[m.v], clouds[m.v][m.index_v])
        q = transform(poses[m.w], clouds[m.w][m.index_w])
        middles.append((p + q) / 2)
        values.append(np.einsum("ij,ij->i", p - q, m.normal))
    points, distances = np.concatenate(middles), np.concatenate(values)
    pick = np.linspace(0, len(points) - 1, min(len(points), _MAP_POINTS)).astype(int)
    return points[pick], distances[pick]


def _plain(figure: Figure) -> Figure:
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    return figure
