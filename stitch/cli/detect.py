"""`stitch detect SESSION`: boards and balls in the scans as labelled points, the table points.csv."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import Json
from stitch.cli.target_options import BallOption, BoardOption


def detect(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Session folder.")],
    board: BoardOption = None,
    ball: BallOption = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="TABLE", help="points.csv to write; default standard output."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Find boards and balls in the scans of a session; with -o SESSION/points.csv they count as labelled points.

    \b
    Examples:
      stitch detect calibration --board charuco:11x8:20:15:DICT_4X4_50 -o calibration/points.csv
      stitch detect calibration --ball any
    """
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.detected_targets import run_detect

    run_detect(session, board, ball, output, as_json)
