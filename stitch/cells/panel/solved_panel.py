"""What `stitch panel` does: a job solved, shown, drawn, as a folder of commands and as sessions."""

import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from stitch.cells.outputs import write_pictures, write_recording_and_page
from stitch.cells.panel import robot_sessions
from stitch.cells.panel.panel_job import PanelJob, read_panel_job
from stitch.cells.panel.panel_output import panel_document, write_folder
from stitch.cells.panel.panel_sentences import leg_sentence, shape_sentence
from stitch.cells.panel.panel_solution import PanelResult, solve_panel_job
from stitch.system.console import console
from stitch.writing.session_files import write_sessions


def run_panel(
    file: Path, output: Path | None, recording: Path | None, report: Path | None, session: Path | None, *, as_json: bool
) -> None:
    """Solve a job and hand out what was asked for.

    Raises:
        InputError, NoResultError: as `stitch panel` ends.
    """
    job = read_panel_job(file)
    result = solve_panel_job(job)
    written = []
    if output is not None:
        written = write_folder(job, result, output) + write_pictures("panel", output, job, result)
    if session is not None:
        write_sessions(session, robot_sessions.robot_sessions(job, result))
    write_recording_and_page("panel", recording, report, job, result)
    if as_json:
        print(json.dumps(panel_document(job, result), indent=1))
        return
    terminal = console()
    _print_model(terminal, result)
    _print_legs(terminal, result)
    _print_moves(terminal, job, result)
    for name in written:
        print(f"{output}/{name}")


def _print_model(terminal: Console, result: PanelResult) -> None:
    table = Table(title="Robots and tracker in one model: 1 σ of the worst axis", title_justify="left")
    for heading in ("robot", "base σ / mm", "base σ / °", "clamp σ / mm", "clamp σ / °", "misfit p"):
        table.add_column(heading)
    for model in result.models:
        sigma = np.sqrt(np.diag(model.covariance)).reshape(4, 3).max(axis=1)
        degrees = np.degrees(sigma)
        cells = (f"{sigma[1]:.3f}", f"{degrees[0]:.4f}", f"{sigma[3]:.3f}", f"{degrees[2]:.4f}", f"{model.p_value:.3g}")
        table.add_row(model.name, *cells)
    terminal.print(table)


def _print_legs(terminal: Console, result: PanelResult) -> None:
    found = [offset for offset in result.legs if offset.detected]
    for o in found:
        terminal.print(leg_sentence(o))
    for model in result.models:
        if model.p_value < 1e-4:
            times = np.sqrt(model.chi_square / model.redundancy)
            terminal.print(
                f"Robot {model.name}: its residuals are {times:.1f} times what the tracker's sigma allows and nothing "
                "known explains them; look at single rows, or at the robot."
            )
    if result.legs and not found:
        terminal.print("No leg offset beyond chance in any robot.")


def _print_moves(terminal: Console, job: PanelJob, result: PanelResult) -> None:
    shift, turn = (errors.position[:, -1].max() for errors in (result.errors.shift, result.errors.turn))
    terminal.print(
        f"With {job.robots[job.master]} as master, the others are off by {shift:.3f} mm rms at most after a shift by "
        f"100 mm, {turn:.3f} mm after a turn by 2°."
    )
    worst = result.errors.by_master.max(axis=1)
    best = int(np.argmin(worst))
    if worst[best] < 0.9 * worst[job.master]:
        terminal.print(
            f"{job.robots[best]} as master would leave {worst[best]:.3f} mm instead of {worst[job.master]:.3f} mm."
        )
    if result.pose_error is not None:
        x, y, z = result.pose_error[3:]
        a, b, c = np.degrees(result.pose_error[:3])
        terminal.print(
            f"Panel off its target by x {x:+.3f}, y {y:+.3f}, z {z:+.3f} mm, turned about x {a:+.4f}, y {b:+.4f}, "
            f"z {c:+.4f}°, in the panel's frame."
        )
    if (shape := shape_sentence(job, result)) is not None:
        terminal.print(shape)
    if job.forces is not None:
        size = np.linalg.norm(job.forces[:, 3:], axis=1)
        terminal.print(f"Largest change of force: {size.max():.1f} N at clamp {job.robots[int(np.argmax(size))]}.")
