"""`stitch view RUN`: open a recording in the Rerun viewer."""

import os
import subprocess
from pathlib import Path
from typing import Annotated

import typer

from stitch.errors import InputError, NoResultError
from viz.rerun_program import rerun_program


def view(run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")]) -> None:
    """Open the recording of a run in the Rerun viewer.

    \b
    Examples:
      stitch view runs/blade-17
    """
    open_recording(run)


def open_recording(run: Path) -> None:
    """Show RUN/recording.rrd.

    Raises:
        InputError: the run has no recording.
        NoResultError: the viewer could not open a window.
    """
    if not run.exists():
        raise InputError(f"{run}: no such run folder; `stitch run` writes one")
    path = run / "recording.rrd" if run.is_dir() else run
    if not path.is_file():
        raise InputError(f"{path}: no recording; run `stitch run` without --no-recording")
    quiet = os.environ | {"RERUN_ANALYTICS": "off"}
    if subprocess.run([rerun_program(), str(path)], env=quiet, check=False).returncode:
        raise NoResultError(f"the viewer could not open {path}; is there a screen?")
