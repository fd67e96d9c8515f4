"""What `stitch run` says at its end: stages, hand-eye with U, errors, verdict, files, the next command."""

import shlex
from pathlib import Path

from rich.console import Console
from rich.table import Table

from stitch.comparison.model_history import model_history
from stitch.comparison.run_verdict import run_light, run_verdict
from stitch.model.hand_eye_uncertainty import hand_eye_lines
from stitch.runs.run import Run
from stitch.system.console import console
from stitch.units import length_text

_FILES = ("stitched.ply", "mesh.ply", "recording.rrd", "report.html")


def show_run(runs: list[Run], target: Path, tolerance: float | None = None, says_next: bool = True) -> None:
    """For people, on standard error; the next command only where it is the reader's to give."""
    terminal = console()
    for result in runs:
        for note in result.notes[: len(result.left_out)]:
            terminal.print(note, soft_wrap=True, style="bold")
        terminal.print(_stage_table(result))
        for s in result.stages[1:]:
            if s.note:
                terminal.print(f"{s.name}: {s.note}.", soft_wrap=True)
        terminal.print(run_verdict(result, model_history(result)), soft_wrap=True, style="bold")
        show_light(terminal, result, tolerance)
        terminal.print(result.verdict, soft_wrap=True)
        hidden = [f"Not observable from these motions: {direction}." for direction in result.unobservable]
        for line in (*hidden, *result.notes[len(result.left_out) :]):
            terminal.print(line, soft_wrap=True)
        terminal.print(_error_sentence(result), soft_wrap=True)
    # Clouds of one rig have one hand-eye, labelled points of one arm each their own.
    own = len(runs) > 1 and not runs[0].session.has_clouds
    for result in runs if own else runs[:1]:
        if own:
            terminal.print(f"{result.session.name}:", soft_wrap=True)
        for line in hand_eye_lines(result.T_mount, result.mount_covariance, result.session.mount, _run_unit(result)):
            terminal.print(line, soft_wrap=True)
    folders = [target] if len(runs) == 1 else [target / result.session.name for result in runs]
    _print_files(terminal, folders)
    if says_next:
        terminal.print(f"Next: stitch diagnose {shlex.quote(str(folders[0]))}", soft_wrap=True)


def show_light(terminal: Console, run: Run, tolerance: float | None) -> None:
    """Whether the part is within what is allowed, as the page's light says it; nothing where nobody says what is."""
    light = None if tolerance is None else run_light(run, model_history(run), tolerance)
    if light is not None:
        terminal.print(light.sentence, soft_wrap=True, style="bold")


def _run_unit(result: Run) -> str:
    return result.session.length_unit


def _stage_table(result: Run) -> Table:
    table = Table(title=result.session.name, title_justify="left")
    for heading in ("stage", "rms", "correspondences", "iterations", "seconds"):
        table.add_column(heading, justify="left" if heading == "stage" else "right")
    for s in result.stages:
        rms = length_text(s.rms, _run_unit(result), 4, zeros=True)
        table.add_row(s.name, rms, f"{s.correspondences:,}", str(s.iterations), f"{s.seconds:.2f}")
    return table


def _error_sentence(result: Run) -> str:
    held, own, floor = (
        length_text(x, _run_unit(result)) for x in (result.heldout_rms, result.residual_rms, result.noise_floor)
    )
    return f"Held-out error {held} (in the fit {own}, noise floor {floor})."


def _print_files(terminal: Console, folders: list[Path]) -> None:
    for folder in folders:
        for name in _FILES:
            if (folder / name).exists():
                terminal.print(f"  {folder / name}", soft_wrap=True)
