"""Page and recording of two robots joined by a stand: bases, rail, rod, and readings that contradict each other."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import MICROMETRES
from stitch.output.comparison.run_verdict import ToleranceVerdict
from stitch.plugins.cells.base_to_base import CONTRADICTION_SIGMAS, BaseResult, comparison_text
from stitch.plugins.cells.stand import DistanceComparison, Stand, compare_distances, rod_points
from viz.cells import stage
from viz.cells.page import Page, Picture, Table, write
from viz.colours import BLUE, GREEN, ORANGE
from viz.figures import above, subplots
from viz.page_parts import Row

# Figures of two robots joined by a stand; each function returns a Figure.

_ONE, _TWO, _ROD = BLUE, GREEN, ORANGE


def plan(stand: Stand, result: BaseResult) -> Figure:
    """From above and from the side."""
    figure, axes = subplots(10.5, 4.8, 1, 2)
    for ax, (i, j) in zip(axes, ((0, 1), (0, 2)), strict=True):
        _draw(ax, stand, result, i, j)
        ax.set(aspect="equal", xlabel=f"{'xyz'[i]} ({stand.length_unit})", ylabel=f"{'xyz'[j]} ({stand.length_unit})")
        ax.margins(0.12)
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
    figure, ax = subplots(7, 0.9 + 0.32 * len(shown))
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
    return figure


def rods(stand: Stand, result: BaseResult) -> tuple[Array, Array]:
    """Pivots and cups (M, 3) as the stand reads them, base 1."""
    T = result.fit.T_base1_stand
    pivots = np.column_stack([stand.slide, 0 * stand.slide, 0 * stand.slide])
    cups = rod_points(stand.slide, stand.angle, stand.length, stand.turn)
    return frames.transform(T, pivots), frames.transform(T, cups)


def write_page(stand: Stand, result: BaseResult | None, path: Path) -> None:
    """Sentence, plan and elevation, contradictions, the transform; without a result the contradictions alone."""
    comparisons = compare_distances(stand) if result is None else result.comparisons
    caption = (
        "Distances that the stand and a robot's joints give independently; beyond "
        f"{CONTRADICTION_SIGMAS:g} sigmas the command refuses to give a transform."
    )
    pictures = [Picture("Do the readings contradict each other?", contradictions(comparisons), caption)]
    tables = [Table("Distances", ("comparison",), [(comparison_text(c, stand.length_unit),) for c in comparisons])]
    verdict, notes = "The readings contradict each other; no transform is given.", []
    worst = max((c.sigmas for c in comparisons), default=0.0)
    light = ToleranceVerdict(
        "bad", f"Readings that should agree differ by {worst:.1f} sigmas; {CONTRADICTION_SIGMAS:g} are allowed."
    )
    if result is not None:
        verdict = sentence(stand, result)
        light = _agreement(worst, len(comparisons))
        notes = [f"No projection: {result.no_projection}."] if result.no_projection else []
        pictures.insert(0, Picture("The stand and both bases", plan(stand, result), _PLAN))
        tables.insert(0, _transforms(stand, result))
    page = Page("Base to base", verdict, stand.file, _about(stand), pictures, tables, notes=notes, light=light)
    write(page, path)


def _agreement(worst: float, count: int) -> ToleranceVerdict:
    if not count:
        return ToleranceVerdict("check", "No reading is there twice: nothing tests the transform.")
    return ToleranceVerdict(
        "good", f"What is read twice agrees: {worst:.1f} sigmas at most, {CONTRADICTION_SIGMAS:g} are allowed."
    )


def _about(stand: Stand) -> list[Row]:
    unit = stand.length_unit
    slide, length, angle = stand.sigma_slide, stand.sigma_length, np.degrees(stand.sigma_angle)
    stated = f"sigma {slide:g} {unit} of the slide, {length:g} {unit} of the length, {angle:.2g}° of the angle"
    return [
        ("Measured", f"{len(stand.rail.names)} points of the rail, {len(stand.rod.names)} settings of the rod"),
        ("Arm", "two: robot 1 touches the rail, robot 2 the cup of the rod"),
        ("Sensor", f"stand with a measuring rod; {stated}"),
    ]


_PLAN = (
    "Left from above, right from the side, in the frame of base 1. Blue: base 1 and the cups that it touched on the "
    "rail. Green: base 2 and the rod's cup as it touched it; the shade is two sigmas of its place, 100 times larger. "
    "Red: the rod from its pivot on the rail (grey) to the cup, as slide, angle and length say."
)


def sentence(stand: Stand, result: BaseResult) -> str:
    """Return a sentence on the place of base 2 and its uncertainty."""
    T, sigma, mm = result.fit.T_base1_base2, result.fit.sigma, MICROMETRES[stand.length_unit] / 1e3
    x, y, z = T[:3, 3]
    turn = np.degrees(np.linalg.norm(frames.log(T)[:3]))
    return (
        f"Base 2 stands at {x:.4f}, {y:.4f}, {z:.4f} {stand.length_unit} in base 1, turned by {turn:.3f}°; one sigma "
        f"is {sigma[3:].max() * mm:.2f} mm and {np.degrees(sigma[:3]).max():.4f}°."
    )


def _transforms(stand: Stand, result: BaseResult) -> Table:
    rows = [("least squares", *_row(result.fit.T_base1_base2))]
    rows.append(
        ("  its sigma", *(f"{s:.5f}" for s in result.fit.sigma[3:]), *(f"{s:.6f}" for s in result.fit.sigma[:3]))
    )
    if result.projection is not None:
        rows.append(("projection", *_row(result.projection.T_base1_base2)))
    unit = stand.length_unit
    header = ("solution", *(f"{k} ({unit})" for k in "xyz"), *(f"about {k} (rad)" for k in "xyz"))
    return Table("T_base1_base2, rotation as a vector", header, rows)


def _row(T: Array) -> list[str]:
    # Adding zero takes the sign of a zero away.
    turn = np.round(frames.log(T)[:3], 6) + 0.0
    return [*(f"{x:.5f}" for x in T[:3, 3]), *(f"{x:.6f}" for x in turn)]


_LEGEND = (
    "Blue: touched by robot 1. Green: touched by robot 2. Red: rod as read, from its pivot on the rail to the cup."
)


def record(stand: Stand, result: BaseResult, path: Path) -> None:
    """Both bases, the rail, the rods and the touched points, frame of base 1."""
    T = result.fit.T_base1_base2
    size = 0.12 * float(np.linalg.norm(T[:3, 3]))
    comparisons = "\n".join(f"- {comparison_text(c, stand.length_unit)}." for c in result.comparisons)
    words = f"# Base to base\n\n{sentence(stand, result)}\n\n{comparisons}\n\n{_LEGEND}"
    pivots, cups = rods(stand, result)
    with stage.stage(path, "Base to base", words) as recording:
        stage.frame(recording, "base 1", np.eye(4), size)
        stage.frame(recording, "base 2", T, size)
        stage.frame(recording, "stand", result.fit.T_base1_stand, size / 2)
        stage.line(recording, "stand/rail", np.vstack([stand.rail.points, pivots]), stage.GREY, size / 25)
        touched = frames.transform(T, stand.rod.points)
        stage.points(recording, "touched/rail", stand.rail.points, [stage.BLUE], size / 15, stand.rail.names)
        stage.points(recording, "touched/rod", touched, [stage.GREEN], size / 15, stand.rod.names)
        for name, pivot, cup in zip(stand.rod.names, pivots, cups, strict=True):
            stage.line(recording, f"stand/rod {name}", np.array([pivot, cup]), stage.RED, size / 50)
        off = frames.rotate(T, result.fit.rod_residuals)
        stage.arrows(recording, "residuals 100 times larger", touched, -100 * off, stage.RED, size / 60)
