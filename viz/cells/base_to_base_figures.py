"""Figures of two robots joined by a stand; each function returns a Figure."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from stitch import frames
from stitch.cells.base_to_base.report import LIMIT, BaseResult
from stitch.cells.base_to_base.stand import Stand, rod_points
from stitch.frames import Array

_ONE, _TWO, _ROD = "#4878a8", "#6a9955", "#b5523b"


def plan(stand: Stand, result: BaseResult) -> Figure:
    """From above and from the side."""
    figure = Figure(figsize=(10.5, 4.8), layout="constrained")
    axes = figure.subplots(1, 2)
    for ax, (i, j) in zip(axes, ((0, 1), (0, 2)), strict=True):
        _draw(ax, stand, result, i, j)
        ax.set(aspect="equal", xlabel=f"{'xyz'[i]} ({stand.length_unit})", ylabel=f"{'xyz'[j]} ({stand.length_unit})")
        ax.margins(0.12)
        ax.spines[["top", "right"]].set_visible(False)
    return figure


def _draw(ax: Axes, stand: Stand, result: BaseResult, i: int, j: int) -> None:
    T = result.fit.T_base1_base2
    touched = frames.transform(T, stand.rod.points)
    pivots, cups = rods(stand, result)
    rail = np.vstack([stand.rail.points, pivots])
    order = np.argsort(rail @ (rail[-1] - rail[0]))
    ax.plot(rail[order, i], rail[order, j], color="0.75", lw=5, zorder=0, solid_capstyle="round")
    for pivot, cup in zip(pivots, cups, strict=True):
        ax.plot([pivot[i], cup[i]], [pivot[j], cup[j]], color=_ROD, lw=1.5)
    size = 0.12 * float(np.ptp(np.vstack([rail, touched, np.zeros((1, 3)), T[None, :3, 3]]), axis=0).max())
    for name, pose, colour, places in (
        ("base 1", np.eye(4), _ONE, stand.rail.points),
        ("base 2", T, _TWO, touched),
    ):
        for place in places:
            ax.plot([pose[i, 3], place[i]], [pose[j, 3], place[j]], color=colour, lw=0.8, ls=":")
        ax.plot(places[:, i], places[:, j], "o", color=colour, ms=6)
        for k, axis in enumerate("xyz"):
            tip = pose[:3, 3] + size * pose[:3, k]
            if np.hypot(*(tip - pose[:3, 3])[[i, j]]) > size / 4:
                ax.annotate(
                    "", tip[[i, j]], pose[[i, j], 3], arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.6}
                )
                ax.annotate(axis, tip[[i, j]], color=colour, fontsize=8)
                ax.update_datalim([tip[[i, j]], (2 * pose[:3, 3] - tip)[[i, j]]])
        ax.annotate(name, pose[[i, j], 3], xytext=(-6, -14), textcoords="offset points", color=colour, weight="bold")
    for label, place in [
        *zip(stand.rail.names, stand.rail.points, strict=True),
        *zip(stand.rod.names, touched, strict=True),
    ]:
        ax.annotate(label, place[[i, j]], xytext=(6, 6), textcoords="offset points", fontsize=9)
    for point in (T[:3, 3],):
        spread = result.fit.covariance[3:, 3:][np.ix_([i, j], [i, j])]
        ax.add_patch(_ellipse(point[[i, j]], spread))


def _ellipse(at: Array, covariance: Array) -> Ellipse:
    """Two sigmas, a hundred times larger: an uncertainty of a millimetre cannot be seen beside metres."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2 * 2 * 100 * np.sqrt(np.maximum(values, 0.0))
    angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
    return Ellipse((float(at[0]), float(at[1])), width, height, angle=angle, facecolor=_TWO, alpha=0.2, lw=0)


def contradictions(result: BaseResult) -> Figure:
    """Every comparison's difference in sigmas."""
    shown = result.comparisons[:12][::-1]
    figure = Figure(figsize=(7, 0.9 + 0.32 * len(shown)), layout="constrained")
    ax = figure.subplots()
    sizes = [c.sigmas for c in shown]
    ax.barh(["–".join(c.pair) for c in shown], sizes, color=[_ROD if s > LIMIT else _ONE for s in sizes], height=0.6)
    ax.axvline(LIMIT, color=_ROD, ls="--", lw=1, label="refused beyond")
    ax.set(xlabel="difference of stand and robot (sigmas)", xlim=(0, max(1.2 * LIMIT, 1.1 * max(sizes, default=0.0))))
    ax.legend(frameon=False, loc="lower right")
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def rods(stand: Stand, result: BaseResult) -> tuple[Array, Array]:
    """Pivots and cups (M, 3) as the stand reads them, base 1."""
    T = result.fit.T_base1_stand
    pivots = np.column_stack([stand.slide, 0 * stand.slide, 0 * stand.slide])
    cups = rod_points(stand.slide, stand.angle, stand.length, stand.turn)
    return frames.transform(T, pivots), frames.transform(T, cups)
