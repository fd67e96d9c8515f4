"""Page and recording of two robots joined by a stand: bases, rail, rod, and readings that contradict each other."""

from pathlib import Path

import numpy as np

from stitch import frames
from stitch.cells.base_to_base import CONTRADICTION_SIGMAS, BaseResult, comparison_text
from stitch.cells.stand import Stand, compare_distances
from stitch.comparison.run_verdict import ToleranceVerdict
from stitch.frames import Array
from stitch.units import MICROMETRES
from viz.cells import stage
from viz.cells.base_to_base_figures import contradictions, plan, rods
from viz.cells.page import Page, Picture, Table, write
from viz.identity import Row


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
    """Where base 2 stands, and how well that is known."""
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
