"""`stitch report RUN`: the page of a run, written anew from its session and model; of two runs, what changed."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.compare import write_comparison
from stitch.cli.diagnose import write_diagnosis
from stitch.cli.options import EffectsFile, RunFolder, Tolerance, Trust, require_tolerance
from stitch.cli.printing import print_page, printing_browser
from stitch.comparison.two_runs import TwoRuns, sentence, two_runs
from stitch.errors import InputError
from stitch.pipeline import diagnose
from stitch.stored.load_state import load_state
from stitch.stored.stored_run import stored_run
from stitch.system.console import console
from stitch.writing import run_folder


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
    if other is None:
        if output is not None:
            raise InputError(f"--output {output}: the page of one run is its report.html; to fix: leave --output away")
        written = _one(run, with_diagnosis is not False, tolerance, printer, effects_file, trust)
    else:
        if with_diagnosis is not None:
            flag = "--diagnosis" if with_diagnosis else "--no-diagnosis"
            raise InputError(f"{flag}: of two runs nothing is diagnosed; to fix: leave {flag} away")
        states = [load_state(folder, effects_file, trust=trust) for folder in _different(run, other)]
        runs = [stored_run(folder, state) for folder, state in zip((run, other), states, strict=True)]
        both = two_runs(runs, _names(run, other))
        written = _two(both, other, output, tolerance, printer)
        console().print(sentence(both), soft_wrap=True, style="bold")
    for path in written:
        console().print(f"  {path}", soft_wrap=True)


def _one(
    run: Path,
    with_diagnosis: bool,
    tolerance: float | None,
    printer: str | None,
    effects_file: Path | None,
    trust: bool,
) -> list[Path]:
    """Write the page of a run; returns its files."""
    page = run / "report.html"
    with run_folder.held(run):
        state = load_state(run, effects_file, trust=trust)
        run_folder.extend("stitch.reports", stored_run(run, state), page, tolerance)
        if with_diagnosis:
            thin = load_state(run, effects_file, thin=True, trust=trust)
            write_comparison(thin, run)
            write_diagnosis(diagnose(thin), thin, run)
        return _printed(page, printer)


def _two(both: TwoRuns, other: Path, output: Path | None, tolerance: float | None, printer: str | None) -> list[Path]:
    """Write the page of two runs; returns its files."""
    if output is None:
        with run_folder.held(other):
            run_folder.extend("stitch.two_run_reports", both, other / "two-runs.html", tolerance)
            return _printed(other / "two-runs.html", printer)
    if output.suffix != ".html" or output.is_dir():
        raise InputError(f"--output {output}: no place for a page; to fix: name a file that ends in .html")
    if not output.parent.is_dir():
        raise InputError(f"--output {output}: its folder does not exist; to fix: make it first")
    run_folder.extend("stitch.two_run_reports", both, output, tolerance)
    return _printed(output, printer)


def _printed(page: Path, printer: str | None) -> list[Path]:
    """The page, and beside it the same on paper if there is a printer."""
    if printer is None:
        return [page]
    paper = page.with_suffix(".pdf")
    print_page(printer, page, paper)
    return [page, paper]


def _different(run: Path, other: Path) -> tuple[Path, Path]:
    if run.resolve() == other.resolve():
        raise InputError(f"{run} and {other} are one run; to fix: name two, or one alone for its own page")
    return run, other


def _names(run: Path, other: Path) -> tuple[str, str]:
    """Names that tell the two folders apart."""
    run, other = run.resolve(), other.resolve()
    return (str(run), str(other)) if run.name == other.name else (run.name, other.name)
