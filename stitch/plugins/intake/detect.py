"""`stitch detect SESSION`: boards and balls in the scans as labelled points, the table points.csv."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import Json, require_new
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, results_stream, say, stdout_for_results
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.plugins.intake.scan_targets import TargetSearch
    from stitch.session.session import Sighting

# Larger balls fit on no table.
_LARGEST_MM = 2000.0

BoardOption = Annotated[
    list[str] | None,
    typer.Option(
        "--board",
        metavar="BOARD",
        help="charuco:11x8:20:15:DICT_4X4_50 (squares; sides of square and marker, mm), checkerboard:9x6:25 (squares; "
        "side), apriltag:36h11:40; may be repeated.",
    ),
]
BallOption = Annotated[
    list[str] | None, typer.Option("--ball", metavar="RADIUS", help="Radius of balls, mm, or any; may be repeated.")
]


@stdout_for_results
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
    from stitch.output.session_files import table_text, write_table
    from stitch.plugins.intake.scan_targets import find_targets, points_columns, scans_of_session, views_of_targets
    from stitch.session.reading.session_folder import load_session
    from stitch.system.files import whole_file

    wanted = parse_target_options(board, ball)
    if wanted.is_empty:
        raise InputError("stitch detect: nothing to look for; to fix: state --board or --ball")
    require_new(output)
    with show_activity("looking for targets in the scans"):
        loaded = load_session(session, at_most=None)
        found, notes = find_targets(scans_of_session(loaded), wanted)
    views = loaded.names
    columns = points_columns(views, found)
    if output is not None:
        with whole_file(output) as scratch:
            write_table(scratch, columns)
    for note in notes:
        say(f"{note}.", stream=sys.stderr)
    if as_json:
        emit(json.dumps(_document(session, views, found, notes), indent=1))
    elif output is None:
        results_stream().write(table_text(columns))
    showing = sum(bool(s.targets) for s in found)
    count = len(views_of_targets(found))
    where = output or "standard output"
    say(f"{where}: {count} target{'s' * (count > 1)} in {showing} of {len(views)} views", stream=sys.stderr)
    if output == session / "points.csv":
        say(f"Next: stitch run {shlex.quote(str(session))}", stream=sys.stderr)


def parse_target_options(board: list[str] | None, ball: list[str] | None) -> TargetSearch:
    """Return what the options say.

    Raises:
        InputError: no board that is known, or no radius.
    """
    from stitch.plugins.intake.detection.boards import parse_board
    from stitch.plugins.intake.scan_targets import TargetSearch

    return TargetSearch(tuple(parse_board(text) for text in board or ()), _ball_radii(ball) if ball else None)


def _ball_radii(stated: list[str]) -> tuple[float, ...]:
    """Return radii in mm; none for balls of any radius."""
    if stated == ["any"]:
        return ()
    try:
        radii = tuple(float(text) for text in stated)
    except ValueError:
        radii = (0.0,)
    if not all(0 < radius < _LARGEST_MM for radius in radii):
        raise InputError(f"--ball {' --ball '.join(stated)}: to fix: state radii in mm, above 0, or any alone")
    return radii


def _document(session: Path, views: list[str], sightings: list[Sighting], notes: list[str]) -> dict[str, object]:
    import numpy as np

    from stitch.plugins.intake.scan_targets import views_of_targets

    return {
        "session": str(session),
        "views": {view: len(s.targets) for view, s in zip(views, sightings, strict=True)},
        "targets": views_of_targets(sightings),
        "median_sigma": float(np.median(np.concatenate([s.sigma for s in sightings]))),
        "notes": notes,
    }
