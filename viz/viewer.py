"""`stitch view RUN`: open a recording in the Rerun viewer."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from stitch.errors import InputError, NoResultError

# Where the program of the rerun library lies.


def rerun_program() -> str:
    """The program that came with the library."""
    return shutil.which("rerun", path=str(Path(sys.executable).parent)) or "rerun"


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
