"""`stitch report RUN`: the page of a run, written anew from its session and model."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.compare import write_comparison
from stitch.cli.diagnose import write_diagnosis
from stitch.cli.options import EffectsFile, Trust
from stitch.pipeline import diagnose
from stitch.stored.load_state import load_state
from stitch.stored.stored_run import stored_run
from stitch.system.console import console
from stitch.writing import run_folder


def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")],
    with_diagnosis: Annotated[
        bool, typer.Option("--diagnosis/--no-diagnosis", help="Compare and diagnose too.")
    ] = True,
    effects_file: EffectsFile = None,
    trust: Trust = False,
) -> None:
    """Write report.html of a run anew, with comparison and diagnosis; nothing is fitted, the model stays as it is."""
    with run_folder.held(run):
        state = load_state(run, effects_file, trust=trust)
        run_folder.extend("stitch.reports", stored_run(run, state), run / "report.html")
        if with_diagnosis:
            thin = load_state(run, effects_file, thin=True, trust=trust)
            write_comparison(thin, run)
            write_diagnosis(diagnose(thin), thin, run)
    console().print(f"  {run / 'report.html'}", soft_wrap=True)
