"""`stitch base FILE`: where the second robot stands as seen from the first."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cells.outputs import JsonOption, RecordingOption, ReportOption, SessionOption


def base(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Readings of the stand, TOML.")],
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the transform between two robot bases from a stand with a measuring rod.

    \b
    Examples:
      stitch base stand.toml --report page.html
    """
    # Loaded by who solves something: whoever asks for help has it at once.
    from stitch.cells.base_to_base.solved_stand import run_base

    run_base(file, recording, report, session, as_json)
