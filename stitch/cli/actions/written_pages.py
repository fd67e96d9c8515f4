"""What `stitch report` does: the page of one run, or of two."""

from pathlib import Path

from stitch.cli.actions.compared_run import write_comparison
from stitch.cli.actions.diagnosed_run import write_diagnosis
from stitch.cli.terminal.printing import print_page
from stitch.cli.terminal.run_summary import show_light
from stitch.comparison.two_runs import TwoRuns, compare_runs, comparison_sentence
from stitch.errors import InputError
from stitch.pipeline import diagnose
from stitch.stored.load_state import load_state
from stitch.stored.stored_run import stored_run
from stitch.system.console import console
from stitch.writing import run_folder


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
    page = run / "report.html"
    with run_folder.lock_run_folder(run):
        state = load_state(run, effects_file, trust=trust)
        shown = stored_run(run, state)
        run_folder.call_entry_points("stitch.reports", shown, page, tolerance)
        show_light(console(), shown, tolerance)
        if with_diagnosis:
            write_comparison(state, run)
            write_diagnosis(diagnose(state), state, run)
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
    states = [load_state(folder, effects_file, trust=trust) for folder in _require_different_runs(run, other)]
    runs = [stored_run(folder, state) for folder, state in zip((run, other), states, strict=True)]
    both = compare_runs(runs, _run_names(run, other))
    written = _write_two_run_files(both, other, output, tolerance, printer)
    console().print(comparison_sentence(both), soft_wrap=True, style="bold")
    _print_paths(written)


def _print_paths(written: list[Path]) -> None:
    for path in written:
        console().print(f"  {path}", soft_wrap=True)


def _write_two_run_files(
    both: TwoRuns, other: Path, output: Path | None, tolerance: float | None, printer: str | None
) -> list[Path]:
    """Write the page of two runs; returns its files."""
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
