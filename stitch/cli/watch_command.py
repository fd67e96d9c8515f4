"""`stitch watch CELL`: what moves in a cell, since when, until when the calibration in use holds."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import Json, Tolerance, require_tolerance
from stitch.cli.streams import emit
from stitch.cli.watch_summary import show
from stitch.errors import InputError
from stitch.system.steps import steps
from stitch.system.whole_file import whole
from stitch.watch.append import append_runs
from stitch.watch.cell_assessment import cell_report
from stitch.watch.cell_course import cell_course
from stitch.watch.cell_report import CellReport
from stitch.watch.dfq import dfq_text
from stitch.watch.history import History, opened
from stitch.watch.openmetrics import openmetrics
from stitch.watch.read_record import read_record
from stitch.watch.report_document import report_document
from stitch.watch.stated_of_cell import measured_at, use
from stitch.writing.json_file import to_json
from stitch.writing.run_folder import extend

_DRIFTS = 3


def watch(
    cells: Annotated[list[Path], typer.Argument(metavar="CELL...", help="Folder of a cell; after --add, its runs.")],
    add: Annotated[bool, typer.Option("--add", help="CELL RUN...: append runs to the history of the cell.")] = False,
    at: Annotated[str, typer.Option("--at", metavar="TIME", help="With --add RUN: when it was measured.")] = "",
    in_use: Annotated[
        Path | None,
        typer.Option("--in-use", metavar="RUN", help="Run whose calibration the cell uses from now on."),
    ] = None,
    tolerance: Tolerance = None,
    page: Annotated[bool, typer.Option("--page/--no-page", help="Write watch.html and watch.prom.")] = True,
    dfq: Annotated[Path | None, typer.Option("--dfq", metavar="FILE", help="Also write the history as Q-DAS.")] = None,
    as_json: Json = False,
) -> None:
    """Watch a cell from day to day: what drifts, since when, beside which channel; exit code 3 if something does.

    \b
    Examples:
      stitch watch cell-7 --add runs/monday-1 runs/monday-2
      stitch watch cell-7 --tolerance 0.1
      stitch watch cell-7 cell-8 cell-9
    """
    require_tolerance(tolerance)
    runs = cells[1:] if add else []
    folders = cells[:1] if add else cells
    _require_sense(add, runs, at, in_use, dfq, folders)
    records = [read_record(run, measured_at(at) if at else None) for run in steps("runs", runs)]
    reports: list[CellReport] = []
    with ExitStack() as stack:
        histories = [stack.enter_context(opened(folder, new=add)) for folder in folders]
        added = append_runs(histories[0], records) if add else 0
        if in_use is not None:
            use(histories[0], in_use)
        reports = [cell_report(history, tolerance) for history in histories]
        if page:
            _write_pages(histories, reports, folders)
        if dfq is not None:
            _write(dfq_text(histories[0], reports[0]), dfq, encoding="utf-8-sig")
    if as_json:
        documents = [report_document(report) for report in reports]
        emit(to_json(documents[0] if len(documents) == 1 else documents))
    else:
        show(reports, folders, added if add else None, page)
    if any(report.alarms for report in reports):
        raise typer.Exit(_DRIFTS)


def _require_sense(
    add: bool, runs: list[Path], at: str, in_use: Path | None, dfq: Path | None, folders: list[Path]
) -> None:
    """Refuse options that do not go together."""
    if add and not runs:
        raise InputError("--add: name the cell first, then its runs: stitch watch CELL --add RUN")
    if at and len(runs) != 1:
        raise InputError("--at: says when one run was measured; to fix: name one RUN with --add")
    if len(folders) > 1 and (in_use is not None or dfq is not None):
        raise InputError("--in-use and --dfq: belong to one cell; to fix: name one")
    names = [folder.resolve().name for folder in folders]
    if len(set(names)) < len(names):
        raise InputError(f"two cells are named {max(names, key=names.count)!r}; to fix: name each once")


def _write_pages(histories: list[History], reports: list[CellReport], folders: list[Path]) -> None:
    """The page and the metrics of every cell, and beside the first the page of all."""
    for history, report, folder in zip(histories, reports, folders, strict=True):
        extend("stitch.watch_pages", cell_course(history, report), folder / "watch.html")
        _write(openmetrics([report]), folder / "watch.prom")
    if len(reports) > 1:
        links = [(report, folder / "watch.html") for report, folder in zip(reports, folders, strict=True)]
        extend("stitch.plant_pages", links, folders[0].parent / "plant.html")


def _write(text: str, path: Path, encoding: str = "utf-8") -> None:
    with whole(path) as file:
        file.write_bytes(text.encode(encoding))
