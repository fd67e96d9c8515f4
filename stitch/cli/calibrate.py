"""`stitch calibrate …`: hand-eyes from known objects and from trackers, and the arm itself."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import Force, Json
from stitch.cli.terminal.streams import stdout_for_results
from stitch.errors import InputError

calibrate = typer.Typer(
    help="Find hand-eyes from known objects and from trackers, and an arm's own errors.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)
_SESSION = Annotated[Path, typer.Argument(metavar="SESSION", help="Session folder.")]


@calibrate.command()
@stdout_for_results
def sphere(
    session: _SESSION,
    radius_free: Annotated[bool, typer.Option("--radius-free", help="Fit the sphere's radius too.")] = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write the JSON there.")] = None,
    as_json: Json = False,
) -> None:
    """Hand-eye from laser-line or area scans of one sphere of known radius.

    \b
    Examples:
      stitch calibrate sphere ball-session
      stitch calibrate sphere ball-session --radius-free -o hand-eye.json
    """
    if output is not None and output.exists() and output.suffix != ".json":
        raise InputError(f"{output}: exists and is no JSON file; name another, or remove it")
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.calibrated_cell import calibrate_by_sphere

    calibrate_by_sphere(session, radius_free, output, as_json)


@calibrate.command()
@stdout_for_results
def tracker(session: _SESSION, as_json: Json = False) -> None:
    """Base and tool from frames.csv: a tracker and its 6D probe, or a camera and its board.

    \b
    Examples:
      stitch calibrate tracker probe-session --json
    """
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.calibrated_cell import calibrate_by_tracker

    calibrate_by_tracker(session, as_json)


@calibrate.command()
@stdout_for_results
def robot(
    session: _SESSION,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT", help="Run folder; default runs/NAME-robot.")
    ] = None,
    force: Force = False,
    at_most: Annotated[int, typer.Option("--at-most", help="Largest number of effects.")] = 8,
    as_json: Json = False,
) -> None:
    """Kinematic calibration: what the arm's nominal model lacks, as model, corrected DH rows and URDF.

    \b
    Examples:
      stitch calibrate robot reflector-session -o runs/arm
    """
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.calibrated_cell import calibrate_arm

    calibrate_arm(session, output, force=force, at_most=at_most, as_json=as_json)
