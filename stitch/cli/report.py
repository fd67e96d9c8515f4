"""`stitch report RUN`: the page of a run, written anew from its session and model."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.compare import write_comparison
from stitch.cli.diagnose import write_diagnosis
from stitch.cli.options import EffectsFile, Tolerance, Trust, require_tolerance
from stitch.cli.printing import print_page, printing_browser
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
    tolerance: Tolerance = None,
    pdf: Annotated[bool, typer.Option("--pdf", help="Also write report.pdf, by a Chromium on the path.")] = False,
    effects_file: EffectsFile = None,
    trust: Trust = False,
) -> None:
    """Write report.html of a run anew, with comparison and diagnosis; nothing is fitted, the model stays as it is.

    \b
    Examples:
      stitch report runs/blade-17 --tolerance 0.1
      stitch report runs/blade-17 --pdf
    """
    require_tolerance(tolerance)
    printer = printing_browser() if pdf else None
    with run_folder.held(run):
        state = load_state(run, effects_file, trust=trust)
        run_folder.extend("stitch.reports", stored_run(run, state), run / "report.html", tolerance)
        if with_diagnosis:
            thin = load_state(run, effects_file, thin=True, trust=trust)
            write_comparison(thin, run)
            write_diagnosis(diagnose(thin), thin, run)
        if printer is not None:
            print_page(printer, run / "report.html", run / "report.pdf")
    for name in ("report.html", *(["report.pdf"] if printer else [])):
        console().print(f"  {run / name}", soft_wrap=True)
