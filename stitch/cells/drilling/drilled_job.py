"""What `stitch drill` does: a job solved, shown, drawn, as a table of drives and as a session."""

import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from stitch.cells.drilling import hole_session
from stitch.cells.drilling.drill_job import read_drill_job
from stitch.cells.drilling.drill_output import drill_document, write_drives
from stitch.cells.drilling.drill_sentences import (
    absent_effect_sentences,
    correction_sentence,
    hand_eye_sentences,
    significant_effect_sentences,
)
from stitch.cells.drilling.drill_solution import DrillResult, solve_drill_job
from stitch.cells.outputs import write_recording_and_page
from stitch.system.console import console
from stitch.writing.session_files import write_session


def run_drill(
    file: Path, output: Path | None, recording: Path | None, report: Path | None, session: Path | None, *, as_json: bool
) -> None:
    """Solve a job and hand out what was asked for.

    Raises:
        InputError, NoResultError: as `stitch drill` ends.
    """
    job = read_drill_job(file)
    result = solve_drill_job(job)
    if output is not None:
        write_drives(result, output)
    if session is not None:
        write_session(session, hole_session.hole_session(job, result))
    write_recording_and_page("drill", recording, report, job, result)
    if as_json:
        print(json.dumps(drill_document(result), indent=1))
    else:
        _print_result(console(), result, job.length_unit)
        if output is not None:
            print(output)


def _print_result(terminal: Console, result: DrillResult, unit: str) -> None:
    terminal.print(correction_sentence(result, unit))
    for line in (
        *hand_eye_sentences(result, unit),
        *significant_effect_sentences(result, unit),
        *absent_effect_sentences(result),
    ):
        terminal.print(line)
    if result.rangers:
        terminal.print(_ranger_table(result, unit))
    terminal.print(_drive_table(result, unit))


def _ranger_table(result: DrillResult, unit: str) -> Table:
    table = Table(title="Beams of the range sensors, in the frame of the flange", title_justify="left")
    for heading in ("sensor", f"origin x y z / {unit}", "direction", f"rms / {unit}"):
        table.add_column(heading)
    for name, beam in result.rangers.items():
        table.add_row(name, _number_text(beam.origin, 3), _number_text(beam.direction, 4), f"{beam.rms:.3f}")
    return table


def _drive_table(result: DrillResult, unit: str) -> Table:
    """Corrected poses of the tool, and how far each went from where the drawing has it."""
    table = Table(title="Drives: T_base_tool, angles about z, y', x''", title_justify="left")
    for heading in ("hole", "group", f"x y z / {unit}", "a b c / °", f"shift / {unit}"):
        table.add_column(heading)
    for drive in result.drives:
        shift = float(np.linalg.norm(drive.position - drive.hole.position))
        place, angles = _number_text(drive.position, 3), _number_text(np.degrees(drive.angles), 3)
        table.add_row(drive.hole.name, drive.hole.group, place, angles, f"{shift:.3f}")
    return table


def _number_text(values: np.ndarray, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
