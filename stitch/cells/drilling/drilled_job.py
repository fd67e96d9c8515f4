"""What `stitch drill` does: a job solved, shown, drawn, as a table of drives and as a session."""

import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from stitch.cells.drilling import hole_session
from stitch.cells.drilling.drill_job import read_job
from stitch.cells.drilling.drill_output import document, write_drives
from stitch.cells.drilling.drill_sentences import effects_not_found, found_effects, hand_eye, worth
from stitch.cells.drilling.drill_solution import JobResult, solve_job
from stitch.cells.outputs import show
from stitch.system.console import console
from stitch.writing.session_files import write_session


def drilled_job(
    file: Path, output: Path | None, recording: Path | None, report: Path | None, session: Path | None, *, as_json: bool
) -> None:
    """Solve a job and hand out what was asked for.

    Raises:
        InputError, NoResultError: as `stitch drill` ends.
    """
    job = read_job(file)
    result = solve_job(job)
    if output is not None:
        write_drives(result, output)
    if session is not None:
        write_session(session, hole_session.session(job, result))
    show("drill", recording, report, job, result)
    if as_json:
        print(json.dumps(document(result), indent=1))
    else:
        _print(console(), result, job.length_unit)
        if output is not None:
            print(output)


def _print(terminal: Console, result: JobResult, unit: str) -> None:
    terminal.print(worth(result, unit))
    for line in (*hand_eye(result, unit), *found_effects(result, unit), *effects_not_found(result)):
        terminal.print(line)
    if result.rangers:
        terminal.print(_rangers(result, unit))
    terminal.print(_drives(result, unit))


def _rangers(result: JobResult, unit: str) -> Table:
    table = Table(title="Beams of the range sensors, in the frame of the flange", title_justify="left")
    for heading in ("sensor", f"origin x y z / {unit}", "direction", f"rms / {unit}"):
        table.add_column(heading)
    for name, beam in result.rangers.items():
        table.add_row(name, _numbers(beam.origin, 3), _numbers(beam.direction, 4), f"{beam.rms:.3f}")
    return table


def _drives(result: JobResult, unit: str) -> Table:
    """Corrected poses of the tool, and how far each went from where the drawing has it."""
    table = Table(title="Drives: T_base_tool, angles about z, y', x''", title_justify="left")
    for heading in ("hole", "group", f"x y z / {unit}", "a b c / °", f"shift / {unit}"):
        table.add_column(heading)
    for drive in result.drives:
        shift = float(np.linalg.norm(drive.position - drive.hole.position))
        place, angles = _numbers(drive.position, 3), _numbers(np.degrees(drive.angles), 3)
        table.add_row(drive.hole.name, drive.hole.group, place, angles, f"{shift:.3f}")
    return table


def _numbers(values: np.ndarray, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
