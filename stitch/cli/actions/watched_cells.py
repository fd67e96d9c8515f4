"""What `stitch watch` does: runs appended, cells judged, pages and metrics written."""

from contextlib import ExitStack
from pathlib import Path

import typer

from stitch.cli.terminal.streams import emit
from stitch.cli.terminal.watch_summary import show_watch
from stitch.system.steps import steps
from stitch.system.whole_file import whole_file
from stitch.watch.append import append_runs
from stitch.watch.cell_assessment import cell_report
from stitch.watch.cell_course import cell_trend
from stitch.watch.cell_report import CellReport
from stitch.watch.dfq import dfq_text
from stitch.watch.history import History, open_history
from stitch.watch.openmetrics import openmetrics
from stitch.watch.read_record import read_record
from stitch.watch.report_document import report_document
from stitch.watch.stated_of_cell import known_run_hash, measured_at, use_calibration
from stitch.writing.json_file import to_json
from stitch.writing.run_folder import call_entry_points

_DRIFTS = 3


def run_watch(
    folders: list[Path],
    runs: list[Path],
    *,
    add: bool,
    at: str,
    in_use: Path | None,
    tolerance: float | None,
    page: bool,
    dfq: Path | None,
    as_json: bool,
) -> None:
    """Judge cells; with `add` these runs are appended to the first, measured at a time that may be stated.

    Raises:
        InputError, NoResultError: as `stitch watch` ends.
        typer.Exit: with 3, where something drifts.
    """
    records = [read_record(run, measured_at(at) if at else None) for run in steps("runs", runs)]
    reports: list[CellReport] = []
    with ExitStack() as stack:
        histories = [stack.enter_context(open_history(folder, new=add)) for folder in folders]
        used = None if in_use is None else known_run_hash(histories[0], in_use, records)
        added = append_runs(histories[0], records) if add else 0
        if used is not None:
            use_calibration(histories[0], used)
        reports = [cell_report(history, tolerance) for history in histories]
        if page:
            _write_pages(histories, reports, folders)
        if dfq is not None:
            _write_text(dfq_text(histories[0], reports[0]), dfq, encoding="utf-8-sig")
    if as_json:
        documents = [report_document(report) for report in reports]
        emit(to_json(documents[0] if len(documents) == 1 else documents))
    else:
        show_watch(reports, folders, added if add else None, page)
    if any(report.alarms for report in reports):
        raise typer.Exit(_DRIFTS)


def _write_pages(histories: list[History], reports: list[CellReport], folders: list[Path]) -> None:
    """The page and the metrics of every cell, and beside the first the page of all."""
    for history, report, folder in zip(histories, reports, folders, strict=True):
        call_entry_points("stitch.watch_pages", cell_trend(history, report), folder / "watch.html")
        _write_text(openmetrics([report]), folder / "watch.prom")
    if len(reports) > 1:
        links = [(report, folder / "watch.html") for report, folder in zip(reports, folders, strict=True)]
        call_entry_points("stitch.plant_pages", links, folders[0].parent / "plant.html")


def _write_text(text: str, path: Path, encoding: str = "utf-8") -> None:
    with whole_file(path) as file:
        file.write_bytes(text.encode(encoding))
