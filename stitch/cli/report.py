"""`stitch report RUN`: the page of a run, written anew from its session and model."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from stitch.cli.diagnose import write_diagnosis
from stitch.diagnosis.diagnose import diagnose
from stitch.state import load_state
from stitch.stored import stored_run
from stitch.writing import run_folder


def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")],
    with_diagnosis: Annotated[bool, typer.Option("--diagnosis/--no-diagnosis", help="Diagnose too.")] = True,
) -> None:
    """Write report.html of a run anew, with its diagnosis; nothing is fitted, the model stays as it is."""
    state = load_state(run)
    run_folder.extend("stitch.reports", stored_run(run, state), run / "report.html")
    if with_diagnosis:
        write_diagnosis(diagnose(state), state, run)
    Console(stderr=True).print(f"  {run / 'report.html'}", highlight=False)
