"""What `stitch drill` does: a job solved, shown, drawn, as a table of drives and as a session."""

import json
from pathlib import Path

import numpy as np
from rich.table import Table

from stitch.cells.drilling import hole_session
from stitch.cells.drilling.drill_job import read_job
from stitch.cells.drilling.drill_output import document, write_drives
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
        _print(result, job.length_unit)


def _print(result: JobResult, unit: str) -> None:
    terminal = console()
    if len(result.leave_one_out_errors):
        sizes = np.linalg.norm(result.leave_one_out_errors, axis=1)
        terminal.print(f"Homography, one hole left out: mean {sizes.mean():.3f}, largest {sizes.max():.3f} {unit}.")
    for name, c in result.groups.items():
        errors, residuals = (np.linalg.norm(values, axis=1) for values in (c.errors, c.residuals))
        terminal.print(
            f"Group {name}: drive errors {errors.min():.3f} to {errors.max():.3f} {unit} at {len(errors)} reference "
            f"holes; {residuals.max():.3f} {unit} at most are left."
        )
    for trial in result.effects.trials if result.effects else ():
        verdict = "found" if trial.accepted else "not found"
        terminal.print(
            f"{trial.effect}: {verdict}, {trial.value:.4g} ± {trial.sigma:.2g} (F {trial.F:.1f}, "
            f"p {trial.p_value:.1e}, BIC {trial.bic_change:+.1f})."
        )
    if (tool := result.tool_axis) is not None:
        verdict = "found" if tool.accepted else "not found"
        terminal.print(
            f"tool axis: {verdict}, {np.degrees(tool.tilt):.2f} ± {np.degrees(tool.sigma):.2f}° off z "
            f"(p {tool.p_value:.1e})."
        )
    for name, r in result.rangers.items():
        terminal.print(
            f"Ranger {name}: origin {_numbers(r.origin)}, direction {_numbers(r.direction)}, rms {r.rms:.3f}."
        )
    table = Table(title="Drives", title_justify="left")
    for heading in ("hole", "group", f"x y z / {unit}", "a b c / °", f"shift / {unit}"):
        table.add_column(heading)
    for drive in result.drives:
        shift = float(np.linalg.norm(drive.position - drive.hole.position))
        angles = _numbers(np.degrees(drive.angles), 3)
        table.add_row(drive.hole.name, drive.hole.group, _numbers(drive.position, 3), angles, f"{shift:.3f}")
    terminal.print(table)


def _numbers(values: np.ndarray, digits: int = 4) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
