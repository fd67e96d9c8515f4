"""`stitch panel JOB`: model, commands and errors of a cell in which several robots hold one panel."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cells.outputs import JobFile, JsonOption, RecordingOption, ReportOption, SessionOption


def panel(
    file: JobFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="For the commands.")] = None,
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    as_json: JsonOption = False,
) -> None:
    """Robots and tracker in one model; where to send the robots for the panel's place, pose and shape.

    \b
    Examples:
      stitch panel job.toml --report page.html
    """
    # Loaded by who solves something: whoever asks for help has it at once.
    from stitch.cells.panel.solved_panel import run_panel

    run_panel(file, output, recording, report, session, as_json=as_json)
