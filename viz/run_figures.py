"""Figures of a run on clouds, by matplotlib; each function returns a Figure."""

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from stitch.frames import Array
from stitch.measurement.session import View
from stitch.runs.run import Run
from stitch.units import MICROMETRES
from viz.colours import BLUE, GREEN
from viz.drawing import above, plain


def convergence(run: Run) -> Figure:
    """Rms of the overlaps at every iteration of correct and register."""
    figure = Figure(figsize=(7, 2.8), layout="constrained")
    axes = figure.subplots()
    um, start = MICROMETRES[run.session.length_unit], 0
    for stage, history in run.convergence.items():
        axes.plot(np.arange(start, start + len(history)), np.array(history) * um, marker=".", label=stage)
        start += len(history)
    axes.axhline(run.noise_floor * um, color="k", lw=1, ls="--", label="noise floor")
    axes.set(ylim=(0, None), xlabel="iteration", ylabel="rms between views (µm)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    above(axes)
    return plain(figure)


def per_view(run: Run) -> Figure:
    """What register moved each view by, and the rms that remains."""
    figure = Figure(figsize=(7, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    um = MICROMETRES[run.session.length_unit]
    names = run.session.names
    left.bar(names, np.linalg.norm(view_shifts(run), axis=1) * um, color=BLUE)
    left.set_ylabel("moved by register (µm)")
    right.bar(names, run.view_rms * um, color=GREEN)
    right.axhline(run.noise_floor * um, color="k", lw=1, ls="--", label="noise floor")
    right.set_ylabel("rms afterwards (µm)")
    above(right)
    for axes in (left, right):
        axes.tick_params(axis="x", rotation=90, labelsize=7)
    return plain(figure)


def view_shifts(run: Run) -> Array:
    """(V, 3) how far register moved the middle of each view, reference frame, length_unit."""
    out = []
    for view, T_before, T_after in zip(run.session.views, run.poses_model, run.poses, strict=True):
        points = shown_points(view)
        middle = points.mean(axis=0) if len(points) else np.zeros(3)
        out.append((T_after - T_before)[:3, :3] @ middle + (T_after - T_before)[:3, 3])
    return np.array(out)


def shown_points(view: View) -> Array:
    """(N, 3) of the view's cloud, or its labelled points, scanner frame."""
    if view.cloud is not None:
        return view.cloud.points
    return np.zeros((0, 3)) if view.sighting is None else view.sighting.points
