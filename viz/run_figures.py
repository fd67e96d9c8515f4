"""Figures of a run on clouds, by matplotlib; each function returns a Figure."""

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from stitch.frames import Array
from stitch.measurement.session import View
from stitch.runs.run import Run
from stitch.units import MICROMETRES
from viz.colours import BLUE, DARK, GREEN, ORANGE, above, plain

# Figures of a run on labelled points, by matplotlib; each function returns a Figure.

# The longest stick covers this share of the targets' spread.
_SHARE = 0.25
_PLANES = ((0, 1), (0, 2), (1, 2))


def sticks(run: Run) -> Figure:
    """Draw each target as seen by every view: magnified sticks from the target's place, in three planes."""
    assert run.targets is not None
    target, residual = residual_vectors(run)
    place, unit = run.targets.landmarks.positions, run.session.length_unit
    size = float(np.nanmax(np.ptp(place[target], axis=0))) or 1.0
    magnified = _SHARE * size / max(float(np.quantile(np.linalg.norm(residual, axis=1), 0.99)), 1e-300)
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    for axes, (a, b) in zip(figure.subplots(1, 3), _PLANES, strict=True):
        ends = np.stack([place[target], place[target] + magnified * residual], axis=1)[:, :, [a, b]]
        axes.add_collection(LineCollection(ends.tolist(), colors=BLUE, linewidths=0.4, alpha=0.35))
        axes.plot(place[:, a], place[:, b], "o", ms=4, color=ORANGE)
        axes.set(aspect="equal", xlabel=f"{'xyz'[a]} ({unit})", ylabel=f"{'xyz'[b]} ({unit})")
    figure.suptitle(f"sticks {magnified:.0f} times longer than they are", fontsize=9)
    return plain(figure)


def errors(run: Run) -> Figure:
    """3D distance of the targets under the model, in the order of views and as a distribution."""
    assert run.targets is not None
    um, rows = MICROMETRES[run.session.length_unit], run.targets.rows
    distances = rows.distances(rows.residual) * um
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    course, share = figure.subplots(1, 2, width_ratios=[2, 1])
    course.plot(np.fmax.reduce(distances, axis=1), ".", ms=2, color=BLUE)
    course.set(xlabel="view", ylabel="farthest target (µm)", ylim=(0, None))
    for values, colour, name in ((distances, BLUE, "in the fit"), (run.targets.heldout * um, ORANGE, "left out")):
        ordered = np.sort(values[np.isfinite(values)])
        share.plot(ordered, np.linspace(0, 100, len(ordered)), color=colour, label=name)
    share.axvline(run.targets.noise_floor * um, color=DARK, lw=1, ls="--", label="noise floor")
    share.set(xlabel="3D distance (µm)", ylabel="share of targets (%)", xlim=(0, None))
    share.legend(frameon=False, fontsize=8)
    return plain(figure)


def residual_vectors(run: Run) -> tuple[Array, Array]:
    """Number of the target (N,) and its offset (N, 3) under the model, reference frame, for all in use."""
    assert run.targets is not None
    rows, s = run.targets.rows, run.targets.rows.sightings
    residual = rows.residual[: len(s.used), : rows.positions].reshape(*s.used.shape, 3)
    return s.target[s.used], residual[s.used]


matplotlib.use("Agg")


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
    """Draw the displacement of each view by register, and the rms that remains."""
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
