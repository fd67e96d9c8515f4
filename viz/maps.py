"""Where on the part the views disagree, before and after: maps with one scale."""

import numpy as np
from matplotlib.figure import Figure

from stitch.frames import Array, transform
from stitch.observations.surfaces.gram import RMS_GATE
from stitch.runs.run import Run
from stitch.statistics.robust import mad_sigma
from stitch.units import MICROMETRES
from viz.colours import UNSIGNED
from viz.drawing import plain

_CELLS = 70  # along the part's longest axis
_ENOUGH = 5  # correspondences that make a cell


def residual_maps(run: Run) -> Figure:
    """Rms distance between the views before and after register."""
    return _maps(run, (run.poses_model, run.poses), ("under the model", "after register"))


def change_maps(run: Run) -> Figure:
    """Rms distance between the views under the model before its last change and under the present one."""
    before = run.poses_model if run.poses_before is None else run.poses_before
    return _maps(run, (before, run.poses_model), ("before the change", "after the change"))


def steps(run: Run, poses: Array) -> tuple[Array, Array]:
    """(M, 3) midpoints of the correspondences and (M,) signed distances along the normal under the given poses."""
    middles, values = [], []
    clouds = [view.cloud.points for view in run.session.views if view.cloud]
    for m in run.overlaps.matches:
        p = transform(poses[m.v], clouds[m.v][m.index_v])
        q = transform(poses[m.w], clouds[m.w][m.index_w])
        middles.append((p + q) / 2)
        values.append(np.einsum("ij,ij->i", p - q, m.normal))
    return np.concatenate(middles), np.concatenate(values)


def _maps(run: Run, poses: tuple[Array, Array], titles: tuple[str, str]) -> Figure:
    """Two maps side by side, seen along the part's thinnest axis; edges beyond the robust gate do not count."""
    um = MICROMETRES[run.session.length_unit]
    states = [steps(run, p) for p in poses]
    points = states[0][0]
    centre = points.mean(axis=0)
    flat = (points - centre) @ np.linalg.eigh(np.cov(points.T))[1][:, :0:-1]
    size = float(np.ptp(flat, axis=0).max()) / _CELLS
    maps = [_cells(flat, values, size) * um for _, values in states]
    limit = float(np.nanquantile(maps[0], 0.97))
    low, high = flat.min(axis=0), flat.max(axis=0)
    height = float(np.clip(4.2 * (high - low)[1] / (high - low)[0], 1.2, 4.5))
    figure = Figure(figsize=(9, height + 0.9), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, values, title in zip(panels, maps, titles, strict=True):
        extent = (low[0], low[0] + size * values.shape[0], low[1], low[1] + size * values.shape[1])
        drawn = axes.imshow(values.T, origin="lower", extent=extent, cmap=UNSIGNED, vmin=0, vmax=limit)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(run.session.length_unit)
    plain(figure)
    figure.colorbar(drawn, ax=panels, label="rms between views (µm)", extend="max")
    return figure


def _cells(flat: Array, values: Array, size: float) -> Array:
    """(X, Y) rms in square cells, NaN where hardly anything lies."""
    inside = np.abs(values) < RMS_GATE * mad_sigma(values)
    index = ((flat - flat.min(axis=0)) / size).astype(int)
    shape = tuple(index.max(axis=0) + 1)
    key = np.ravel_multi_index(tuple(index[inside].T), shape)
    count = np.bincount(key, minlength=shape[0] * shape[1])
    square = np.bincount(key, values[inside] ** 2, shape[0] * shape[1])
    return np.sqrt(np.where(count >= _ENOUGH, square / np.maximum(count, 1), np.nan)).reshape(shape)
