"""`stitch report RUN`: the page of a run, written anew from its session and model; of two runs, what changed."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import EffectsFile, RunFolder, Tolerance, Trust, require_tolerance
from stitch.cli.terminal.printing import printing_browser
from stitch.errors import InputError


def report(
    run: RunFolder,
    other: Annotated[
        Path | None, typer.Argument(metavar="[RUN2]", help="Another: write what changed from RUN to RUN2.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Of two runs; default RUN2/two-runs.html.")
    ] = None,
    with_diagnosis: Annotated[
        bool | None,
        typer.Option("--diagnosis/--no-diagnosis", help="Of one run: compare and diagnose too; default so."),
    ] = None,
    tolerance: Tolerance = None,
    pdf: Annotated[bool, typer.Option("--pdf", help="Also write the page as PDF, by a Chromium on the path.")] = False,
    effects_file: EffectsFile = None,
    trust: Trust = False,
) -> None:
    """Write report.html of a run anew, with comparison and diagnosis; nothing is fitted, the model stays as it is.

    \b
    Of two runs, write one page of what changed from the first to the second.

    \b
    Examples:
      stitch report runs/blade-17 --tolerance 0.1
      stitch report runs/blade-17 --pdf
      stitch report runs/before runs/after
    """
    require_tolerance(tolerance)
    printer = printing_browser() if pdf else None
    if other is None and output is not None:
        raise InputError(f"--output {output}: the page of one run is its report.html; to fix: leave --output away")
    if other is not None and with_diagnosis is not None:
        flag = "--diagnosis" if with_diagnosis else "--no-diagnosis"
        raise InputError(f"{flag}: of two runs nothing is diagnosed; to fix: leave {flag} away")
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.written_pages import write_run_page, write_two_run_page

    if other is None:
        write_run_page(run, with_diagnosis is not False, tolerance, printer, effects_file, trust)
    else:
        write_two_run_page(run, other, output, tolerance, printer, effects_file, trust)
