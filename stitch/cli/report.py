"""`stitch report RUN`: the page of a run, written anew from its session and model."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from stitch.cli.diagnose import write_diagnosis
from stitch.diagnosis.diagnose import diagnose
from stitch.pipeline import change
from stitch.state import load_state
from stitch.writing import run_folder


def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")],
    with_diagnosis: Annotated[bool, typer.Option("--diagnosis/--no-diagnosis", help="Diagnose too.")] = True,
) -> None:
    """Write report.html of a run anew, with its diagnosis; the model and its history stay as they are."""
    state = load_state(run)
    result = change(state, [t.effect.name for t in state.terms])
    # Nothing has changed now: there is no before and after to show.
    shown = replace(result, ledger=state.ledger, poses_before=None)
    run_folder.extend("stitch.reports", shown, run / "report.html")
    if with_diagnosis:
        write_diagnosis(diagnose(state), state, run)
    Console(stderr=True).print(f"  {run / 'report.html'}", highlight=False)
