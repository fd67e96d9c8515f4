"""Figures of two robots joined by a stand; each function returns a Figure."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from stitch import frames
from stitch.cells.base_to_base import CONTRADICTION_SIGMAS, BaseResult
from stitch.cells.stand import DistanceComparison, Stand, rod_points
from stitch.frames import Array
from viz.colours import BLUE, GREEN, ORANGE
from viz.drawing import above

_ONE, _TWO, _ROD = BLUE, GREEN, ORANGE


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
    """The plane of axes i and j of base 1."""
    T, (pivots, cups) = result.fit.T_base1_base2, rods(stand, result)
    touched, rail = frames.transform(T, stand.rod.points), np.vstack([stand.rail.points, pivots])
    rail = rail[np.argsort(rail @ (rail[-1] - rail[0]))]
    ax.plot(rail[:, i], rail[:, j], color="0.75", lw=5, zorder=0, solid_capstyle="round")
    for pivot, cup in zip(pivots, cups, strict=True):
        ax.plot([pivot[i], cup[i]], [pivot[j], cup[j]], color=_ROD, lw=1.5)
    size = 0.12 * float(np.ptp(np.vstack([rail, touched, np.zeros((1, 3)), T[None, :3, 3]]), axis=0).max())
    for name, pose, colour, places, labels in (
        ("base 1", np.eye(4), _ONE, stand.rail.points, stand.rail.names),
        ("base 2", T, _TWO, touched, stand.rod.names),
    ):
        _draw_base(ax, name, pose, size, colour, [i, j])
        for place in places[:, [i, j]]:
            ax.plot(*np.array([pose[[i, j], 3], place]).T, color=colour, lw=0.8, ls=":")
            ax.plot(*place, "o", color=colour, ms=6)
        _name_places(ax, places[:, [i, j]], labels, pose[i, 3], size / 4)
    ax.add_patch(_ellipse(T[[i, j], 3], result.fit.covariance[3:, 3:][np.ix_([i, j], [i, j])]))


def _name_places(ax: Axes, places: Array, labels: Sequence[str], middle: float, near: float) -> None:
    """Names on the side that looks away from the middle; places that fall together share one."""
    left = list(range(len(places)))
    while left:
        at = places[left[0]]
        here = [k for k in left if np.linalg.norm(places[k] - at) < near]
        left = [k for k in left if k not in here]
        side = 1 if at[0] >= middle else -1
        style = {"ha": "left" if side > 0 else "right", "textcoords": "offset points", "fontsize": 9}
        ax.annotate(", ".join(labels[k] for k in here), at, xytext=(6 * side, 6), **style)


def _draw_base(ax: Axes, name: str, T: Array, size: float, colour: str, plane: list[int]) -> None:
    """Axes of a base (4, 4) as far as they show in the plane, and its name."""
    origin = T[plane, 3]
    # On the side to which no axis points.
    below = T[plane[1], :3].sum() > -0.5
    for k, axis in enumerate("xyz"):
        arrow = size * T[plane, k]
        if np.hypot(*arrow) > size / 4:
            style = {"arrowstyle": "->", "color": colour, "lw": 1.6}
            ax.annotate("", origin + arrow, origin, arrowprops=style)
            ax.annotate(axis, origin + arrow, color=colour, fontsize=8)
            # Arrows do not count for the limits of the axes by themselves.
            ax.update_datalim([origin + arrow, origin - arrow])
    ax.annotate(name, origin, xytext=(-6, -14 if below else 8), textcoords="offset points", color=colour, weight="bold")


def _ellipse(at: Array, covariance: Array) -> Ellipse:
    """Two sigmas, a hundred times larger: an uncertainty of a millimetre cannot be seen beside metres."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2 * 2 * 100 * np.sqrt(np.maximum(values, 0.0))
    angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
    return Ellipse((float(at[0]), float(at[1])), width, height, angle=angle, facecolor=_TWO, alpha=0.2, lw=0)


def contradictions(comparisons: Sequence[DistanceComparison]) -> Figure:
    """Every comparison's difference in sigmas."""
    shown = comparisons[:12][::-1]
    figure = Figure(figsize=(7, 0.9 + 0.32 * len(shown)), layout="constrained")
    ax = figure.subplots()
    sizes = [c.sigmas for c in shown]
    ax.barh(
        ["–".join(c.pair) for c in shown],
        sizes,
        color=[_ROD if s > CONTRADICTION_SIGMAS else _ONE for s in sizes],
        height=0.6,
    )
    ax.axvline(CONTRADICTION_SIGMAS, color=_ROD, ls="--", lw=1, label="refused beyond")
    ax.set(
        xlabel="difference of stand and robot (sigmas)",
        xlim=(0, max(1.2 * CONTRADICTION_SIGMAS, 1.1 * max(sizes, default=0.0))),
    )
    above(ax)
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def rods(stand: Stand, result: BaseResult) -> tuple[Array, Array]:
    """Pivots and cups (M, 3) as the stand reads them, base 1."""
    T = result.fit.T_base1_stand
    pivots = np.column_stack([stand.slide, 0 * stand.slide, 0 * stand.slide])
    cups = rod_points(stand.slide, stand.angle, stand.length, stand.turn)
    return frames.transform(T, pivots), frames.transform(T, cups)
