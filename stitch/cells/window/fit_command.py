"""`stitch fit JOB`: where the parts lie, how they differ from their CAD, and the robot path that follows them."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cells.outputs import JobFile, JsonOption, RecordingOption, ReportOption, SessionOption


def fit(
    file: JobFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="For map and path.")] = None,
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    allowance: Annotated[
        str | None,
        typer.Option(
            metavar="free|varying|SIZE", help="Stock on a casting, outside = plus: found evenly, varying, or stated."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Fit scans onto a CAD model without a guess: pose, deviation map and corrected robot path.

    \b
    Examples:
      stitch fit fit.toml --report page.html
      stitch fit casting.toml --allowance free
    """
    # Loaded by who solves something: whoever asks for help has it at once.
    from stitch.cells.window.fitted_parts import run_fit

    run_fit(file, allowance, output, recording, report, session=session, as_json=as_json)
