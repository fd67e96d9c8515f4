"""`stitch report RUN`: the page of a run, written anew from its session and model."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from stitch.cli.compare import write_comparison
from stitch.cli.diagnose import write_diagnosis
from stitch.diagnosis.diagnose import diagnose
from stitch.stored.load_state import load_state
from stitch.stored.stored_run import stored_run
from stitch.writing import run_folder


def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")],
    with_diagnosis: Annotated[
        bool, typer.Option("--diagnosis/--no-diagnosis", help="Compare and diagnose too.")
    ] = True,
) -> None:
    """Write report.html of a run anew, with comparison and diagnosis; nothing is fitted, the model stays as it is."""
    state = load_state(run)
    run_folder.extend("stitch.reports", stored_run(run, state), run / "report.html")
    if with_diagnosis:
        thin = load_state(run, thin=True)
        write_comparison(thin, run)
        write_diagnosis(diagnose(thin), thin, run)
    Console(stderr=True).print(f"  {run / 'report.html'}", highlight=False)
