"""`stitch drill JOB`: where the robot must be sent so that the holes come where they belong."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cells.outputs import JobFile, JsonOption, RecordingOption, ReportOption, SessionOption


def drill(
    file: JobFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="CSV", help="Write the drives.")] = None,
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    as_json: JsonOption = False,
) -> None:
    """Correct the drives of holes from reference holes that the robot has seen.

    \b
    Examples:
      stitch drill job.toml --report page.html
    """
    # Loaded by who solves something: whoever asks for help has it at once.
    from stitch.cells.drilling.drilled_job import run_drill

    run_drill(file, output, recording, report, session, as_json=as_json)
