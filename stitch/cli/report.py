"""`stitch report RUN`: the page of a run, written anew from its session and model; of two runs, what changed."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import EffectsFile, RunFolder, Tolerance, Trust, require_tolerance
from stitch.cli.progress import opened_run, show_activity
from stitch.cli.terminal import say
from stitch.errors import InputError, NoResultError

# Browsers that print a page to PDF.
_CHROMES = ("google-chrome", "google-chrome-stable", "chrome")
_BROWSERS = ("chromium", "chromium-browser", *_CHROMES, "microsoft-edge", "msedge")
_SECONDS = 120


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
    browser = printing_browser() if pdf else None
    if other is None and output is not None:
        raise InputError(f"--output {output}: the page of one run is its report.html; to fix: leave --output away")
    if other is not None and with_diagnosis is not None:
        flag = "--diagnosis" if with_diagnosis else "--no-diagnosis"
        raise InputError(f"{flag}: of two runs nothing is diagnosed; to fix: leave {flag} away")
    if other is None:
        page = _write_run_page(run, with_diagnosis is not False, tolerance, effects_file, trust)
    else:
        page = _write_two_run_page(run, other, output, tolerance, effects_file, trust)
    say(f"  {page}")
    if browser is not None:
        print_page(browser, page, page.with_suffix(".pdf"))
        say(f"  {page.with_suffix('.pdf')}")


def printing_browser() -> str:
    """Return the path of a browser that prints.

    Raises:
        InputError: none is on the path.
    """
    path = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if path is None:
        raise InputError(
            "--pdf: no Chromium, Chrome or Edge is on the path; to fix: install one, or print report.html by hand"
        )
    return path


def print_page(browser: str, page: Path, path: Path) -> None:
    """Write the PDF of an HTML page, completely or not at all.

    Args:
        browser: path of a Chromium browser.
        page: HTML file.
        path: PDF file to write.

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
            raise NoResultError(f"{browser} could not print {page}; to fix: print it by hand") from None


def _write_run_page(
    run: Path, with_diagnosis: bool, tolerance: float | None, effects_file: Path | None, trust: bool
) -> Path:
    """Write report.html of a run folder again, and return its path.

    Args:
        with_diagnosis: also compare and diagnose, unless the page already shows a diagnosis of this very model.
        tolerance: within which the views have to agree on the part, length_unit; None: not stated.
    """
    from stitch.api import pipeline
    from stitch.cli.compare import write_comparison
    from stitch.cli.diagnose import write_diagnosis
    from stitch.cli.run import show_light
    from stitch.output import run_folder, stored_run

    page = run / "report.html"
    activity = "report: reading the scans, writing the page"
    with opened_run(run, effects_file, trust, activity) as state:
        with show_activity(activity):
            run_folder.call_entry_points("stitch.reports", state, page, tolerance, required=True)
        show_light(state, tolerance)
        if not with_diagnosis:
            return page
        # A diagnosis of this very model stays on the page.
        shows_diagnosis = page.is_file() and 'id="screen-data"' in page.read_text(encoding="utf-8")
        is_current = shows_diagnosis and bool(stored_run.standing_diagnosis(run, state))
        if not is_current or not (run / "compare.json").is_file():
            write_comparison(state, run)
        if not is_current:
            with show_activity("diagnosing: trying every effect"):
                diagnosis = pipeline.diagnose(state)
            write_diagnosis(diagnosis, state, run)
    return page


def _write_two_run_page(
    run: Path, other: Path, output: Path | None, tolerance: float | None, effects_file: Path | None, trust: bool
) -> Path:
    """Write the page of what changed from the run `run` to the run `other`, and return its path.

    Args:
        output: file of the page; None: two-runs.html in the folder of `other`, which is then locked.
        tolerance: within which the views have to agree on the part, length_unit; None: not stated.

    Raises:
        InputError: both are one run, or `output` is no place for a page.
    """
    from stitch.output import run_folder, stored_run
    from stitch.output.comparison.two_runs import compare_runs, comparison_sentence

    if run.resolve() == other.resolve():
        raise InputError(f"{run} and {other} are one run; to fix: name two, or one alone for its own page")
    if output is not None:
        if output.suffix != ".html" or output.is_dir():
            raise InputError(f"--output {output}: no place for a page; to fix: name a file that ends in .html")
        if not output.parent.is_dir():
            raise InputError(f"--output {output}: its folder does not exist; to fix: make it first")
    folders = (run.resolve(), other.resolve())
    names = [folder.name for folder in folders]
    with show_activity("report: reading both runs"):
        runs = [stored_run.load_run(folder, effects_file, trust=trust) for folder in (run, other)]
        both = compare_runs(runs, [str(folder) for folder in folders] if names[0] == names[1] else names)
    page = output or other / "two-runs.html"
    with nullcontext() if output else run_folder.lock_run_folder(other):
        run_folder.call_entry_points("stitch.two_run_reports", both, page, tolerance, required=True)
    say(comparison_sentence(both), bold=True)
    return page
