"""`stitch panel JOB`: model, commands and errors of a cell in which several robots hold one panel."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cells.outputs import RecordingOption, ReportOption, SessionOption


def panel(
    file: Annotated[Path, typer.Argument(metavar="JOB", help="Job file, TOML.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="For the commands.")] = None,
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON alone on standard output.")] = False,
) -> None:
    """Robots and tracker in one model; where to send the robots for the panel's place, pose and shape.

    \b
    Examples:
      stitch panel job.toml --report page.html
    """
    # Loaded by who solves something: whoever asks for help has it at once.
    from stitch.cells.panel.solved_panel import solved_panel

    solved_panel(file, output, recording, report, session, as_json=as_json)
