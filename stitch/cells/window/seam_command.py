"""`stitch seam JOB`: flush and gap around a window."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cells.outputs import JobFile, JsonOption, RecordingOption, ReportOption, SessionOption


def seam(
    file: JobFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="CSV", help="Write the stations.")] = None,
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure flush and gap at the stations of a seam, with uncertainty and verdict.

    \b
    Examples:
      stitch seam seam.toml --report page.html
    """
    # Loaded by who solves something: whoever asks for help has it at once.
    from stitch.cells.window.measured_seam import run_seam

    run_seam(file, output, recording, report, session, as_json=as_json)
