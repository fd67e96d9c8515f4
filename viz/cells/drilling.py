"""Page and recording of a drilling job: where the holes are, and what the correction does to the drives' errors."""

from pathlib import Path

import numpy as np

from stitch.cells.drilling import DrillJob, DrillResult, Drive, correction_sentence, significant_effect_sentences
from stitch.frames import transform
from viz.cells import stage
from viz.cells.drilling_figures import holes, magnified, plate, references_of
from viz.cells.page import Page, Picture, Table, write
from viz.identity import Row


def write_page(job: DrillJob, result: DrillResult, path: Path) -> None:
    """Sentence, holes with error arrows before and after, plate, tables."""
    caption = (
        "Arrows: where a reference hole really is, seen from where its drive was expected to meet it, "
        f"{magnified(job, result):g} times larger. Left by the drawing; right after the correction of its group, with "
        "which the holes to drill move."
    )
    pictures = [Picture("Holes and drive errors", holes(job, result), caption)]
    if len(result.leave_one_out_errors):
        caption = "Each of the plate's holes mapped by a homography of the others: what camera and plate are worth."
        pictures.append(Picture("Hand-eye: one hole left out", plate(job, result), caption))
    words = (correction_sentence(result, job.length_unit), job.file, _about(job))
    notes = list(significant_effect_sentences(result, job.length_unit))
    write(Page("Drilling", *words, pictures, _tables(job, result), notes=notes), path)


def _about(job: DrillJob) -> list[Row]:
    references = sum(hole.reference for hole in job.holes)
    groups = len({hole.group for hole in job.holes})
    rangers = f", {len(job.rangers)} range sensors" if job.rangers else ""
    return [
        ("Measured", f"{len(job.holes)} holes in {groups} groups, {references} of them references that were seen"),
        ("Arm", "not stated"),
        ("Sensor", f"camera on the flange, by a plate of {len(job.plate_uv)} holes{rangers}"),
    ]


def _tables(job: DrillJob, result: DrillResult) -> list[Table]:
    unit = job.length_unit
    references = [
        (hole.name, name, f"{np.linalg.norm(error):.3f}", f"{np.linalg.norm(residual):.3f}")
        for name, c in result.groups.items()
        for hole, error, residual in zip(references_of(job, name), c.errors, c.residuals, strict=True)
    ]
    drives = [(d.hole.name, d.hole.group, *(f"{x:.3f}" for x in _drive_numbers(d))) for d in result.drives]
    header = ("hole", "group", *(f"{k} ({unit})" for k in "xyz"), "a (°)", "b (°)", "c (°)", f"moved ({unit})")
    return [
        Table("Reference holes", ("hole", "group", f"error before ({unit})", f"left after ({unit})"), references),
        Table("Drives", header, drives),
    ]


def _drive_numbers(d: Drive) -> list[float]:
    """Position, angles in degrees, and how far the drive moved."""
    return [*d.position, *np.degrees(d.angles), float(np.linalg.norm(d.position - d.hole.position))]


def record(job: DrillJob, result: DrillResult, path: Path) -> None:
    """Nominal, measured and corrected holes in the base frame, error arrows before and after."""
    places = np.array([hole.position for hole in job.holes])
    size = float(np.ptp(places, axis=0).max())
    with stage.stage(path, "Drilling", _words(job, result)) as recording:
        stage.points(recording, "holes/drawing", places, [stage.GREY], size / 150, [hole.name for hole in job.holes])
        for name, c in result.groups.items():
            nominal = np.array([hole.position for hole in references_of(job, name)])
            corrected, length = transform(c.T_actual_nominal, nominal), magnified(job, result)
            stage.points(recording, f"holes/measured/{name}", nominal + c.errors, [stage.BLUE], size / 150)
            args = (nominal, c.errors * length, stage.RED, size / 400)
            stage.arrows(recording, f"errors/before/{name}", *args)
            stage.arrows(recording, f"errors/after/{name}", corrected, c.residuals * length, stage.GREEN, size / 300)
        drives = np.array([d.position for d in result.drives])
        inward = np.array([d.direction for d in result.drives])
        stage.points(recording, "holes/corrected", drives, [stage.GREEN], size / 150)
        stage.arrows(recording, "drives", drives - inward * size / 8, inward * size / 8, stage.GREEN, size / 500)
        for name, placed in job.placed.items():
            stage.frame(recording, f"tool on {name}", placed.T_base_tool, size / 15)


def _words(job: DrillJob, result: DrillResult) -> str:
    notes = "\n".join(f"- {note}" for note in significant_effect_sentences(result, job.length_unit))
    return (
        f"# Drilling\n\n{correction_sentence(result, job.length_unit)}\n\n{notes}\n\nGrey: drawing. Blue: "
        "reference holes as "
        "measured. Green: corrected drives. Red and green arrows: errors before and after, "
        f"{magnified(job, result):g} times larger."
    )
