"""`stitch batch SESSION…`: many sessions, each a run of its own, on one process or many."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import Json
from stitch.errors import InputError


def batch(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Session folders.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where the runs go.")] = Path("runs"),
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes on this machine.")] = 1,
    scheduler: Annotated[
        str, typer.Option("--scheduler", metavar="tcp://…", help="Workers of a Dask scheduler that runs already.")
    ] = "",
    force: Annotated[
        bool, typer.Option("--force", help="Run finished sessions too, and replace runs of other sessions.")
    ] = False,
    recording: Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd.")] = True,
    as_json: Json = False,
) -> None:
    """Run many sessions; one that fails does not stop the others. Started again, it runs what is not finished.

    \b
    Examples:
      stitch batch blade-17 blade-18 blade-19 -o runs --workers 2
      stitch batch blade-* --scheduler tcp://10.0.0.5:8786
    """
    if scheduler and workers > 1:
        raise InputError("--workers and --scheduler: the scheduler has workers of its own; to fix: name one of the two")
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.batch_sessions import run_batch

    run_batch(sessions, output, workers, scheduler, force=force, recording=recording, as_json=as_json)
