"""`stitch report RUN`: the page of a run, written anew from its session and model; of two runs, what changed."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import EffectsFile, RunFolder, Tolerance, Trust, require_tolerance
from stitch.errors import InputError, NoResultError

if TYPE_CHECKING:
    from stitch.comparison.two_runs import TwoRuns


# A page on paper: printed to PDF by a Chromium that is on the path.

_BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
    "msedge",
)
_SECONDS = 120


def printing_browser() -> str:
    """Path of a browser that prints.

    Raises:
        InputError: none is on the path.
    """
    found = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        raise InputError(
            "--pdf: no Chromium, Chrome or Edge is on the path; to fix: install one, or print report.html by hand"
        )
    return found


def print_page(browser: str, page: Path, path: Path) -> None:
    """Print `page` to `path`, whole or not at all.

    Raises:
        NoResultError: the browser did not print.
    """
    from stitch.system.files import whole_file

    # As root a browser has no sandbox, and without a display no graphics card.
    root = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    with whole_file(path) as file, tempfile.TemporaryDirectory() as profile:
        arguments = ["--headless", "--disable-gpu", *root, f"--user-data-dir={profile}", "--no-pdf-header-footer"]
        target = Path(profile) / "page.pdf"
        try:
            subprocess.run(
                [browser, *arguments, f"--print-to-pdf={target}", page.resolve().as_uri()],
                capture_output=True,
                timeout=_SECONDS,
                check=True,
            )
            shutil.copyfile(target, file)
        except (subprocess.SubprocessError, OSError):
            raise NoResultError(f"{browser} could not print {page}; print it by hand") from None


# What `stitch report` does: the page of one run, or of two.


def write_run_page(
    run: Path,
    with_diagnosis: bool,
    tolerance: float | None,
    printer: str | None,
    effects_file: Path | None,
    trust: bool,
) -> None:
    """Write the page of a run, on paper too where there is a printer.

    Raises:
        InputError, NoResultError: as `stitch report` ends.
    """
    from stitch.cli.compare import write_comparison
    from stitch.cli.diagnose import write_diagnosis
    from stitch.cli.run import show_light
    from stitch.pipeline import diagnose
    from stitch.stored.stored_run import load_run
    from stitch.system.process import console
    from stitch.writing import run_folder

    page = run / "report.html"
    with run_folder.lock_run_folder(run):
        shown = load_run(run, effects_file, trust=trust)
        run_folder.call_entry_points("stitch.reports", shown, page, tolerance)
        show_light(console(), shown, tolerance)
        if with_diagnosis:
            write_comparison(shown, run)
            write_diagnosis(diagnose(shown), shown, run)
        _print_paths(_print_to_pdf(page, printer))


def write_two_run_page(
    run: Path,
    other: Path,
    output: Path | None,
    tolerance: float | None,
    printer: str | None,
    effects_file: Path | None,
    trust: bool,
) -> None:
    """Write the page of two runs, on paper too where there is a printer.

    Raises:
        InputError, NoResultError: as `stitch report` ends.
    """
    from stitch.comparison.two_runs import compare_runs, comparison_sentence
    from stitch.stored.stored_run import load_run
    from stitch.system.process import console

    runs = [load_run(folder, effects_file, trust=trust) for folder in _require_different_runs(run, other)]
    both = compare_runs(runs, _run_names(run, other))
    written = _write_two_run_files(both, other, output, tolerance, printer)
    console().print(comparison_sentence(both), soft_wrap=True, style="bold")
    _print_paths(written)


def _print_paths(written: list[Path]) -> None:
    from stitch.system.process import console

    for path in written:
        console().print(f"  {path}", soft_wrap=True)


def _write_two_run_files(
    both: TwoRuns, other: Path, output: Path | None, tolerance: float | None, printer: str | None
) -> list[Path]:
    """Write the page of two runs; returns its files."""
    from stitch.writing import run_folder

    if output is None:
        with run_folder.lock_run_folder(other):
            run_folder.call_entry_points("stitch.two_run_reports", both, other / "two-runs.html", tolerance)
            return _print_to_pdf(other / "two-runs.html", printer)
    if output.suffix != ".html" or output.is_dir():
        raise InputError(f"--output {output}: no place for a page; to fix: name a file that ends in .html")
    if not output.parent.is_dir():
        raise InputError(f"--output {output}: its folder does not exist; to fix: make it first")
    run_folder.call_entry_points("stitch.two_run_reports", both, output, tolerance)
    return _print_to_pdf(output, printer)


def _print_to_pdf(page: Path, printer: str | None) -> list[Path]:
    """The page, and beside it the same on paper if there is a printer."""
    if printer is None:
        return [page]
    paper = page.with_suffix(".pdf")
    print_page(printer, page, paper)
    return [page, paper]


def _require_different_runs(run: Path, other: Path) -> tuple[Path, Path]:
    if run.resolve() == other.resolve():
        raise InputError(f"{run} and {other} are one run; to fix: name two, or one alone for its own page")
    return run, other


def _run_names(run: Path, other: Path) -> tuple[str, str]:
    """Names that tell the two folders apart."""
    run, other = run.resolve(), other.resolve()
    return (str(run), str(other)) if run.name == other.name else (run.name, other.name)


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

    if other is None:
        write_run_page(run, with_diagnosis is not False, tolerance, printer, effects_file, trust)
    else:
        write_two_run_page(run, other, output, tolerance, printer, effects_file, trust)
