"""`stitch view RUN`: open a recording in the Rerun viewer."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from stitch.errors import InputError, NoResultError


def view(run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")]) -> None:
    """Open the recording of a run in the Rerun viewer."""
    open_recording(run)


def open_recording(run: Path) -> None:
    """Show RUN/recording.rrd, and RUN/diagnosis.rrd where there is one.

    Raises:
        InputError: the run has no recording.
        NoResultError: the viewer could not open a window.
    """
    path = run / "recording.rrd" if run.is_dir() else run
    if not path.is_file():
        raise InputError(f"{path}: no recording; run `stitch run` without --no-recording")
    viewer = shutil.which("rerun", path=str(Path(sys.executable).parent)) or "rerun"
    files = [str(p) for p in (path, path.with_name("diagnosis.rrd")) if p.is_file()]
    if subprocess.run([viewer, *files], env=os.environ | {"RERUN_ANALYTICS": "off"}, check=False).returncode:
        raise NoResultError(f"the viewer could not open {path}; is there a screen?")
