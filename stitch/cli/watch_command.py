"""`stitch watch CELL`: what moves in a cell, since when, until when the calibration in use holds."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import Json, Tolerance, require_tolerance
from stitch.cli.terminal import emit
from stitch.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from stitch.watch.history import History
    from stitch.watch.report import CellReport, ParameterReport


# What `stitch watch` says for people: a table a cell, one line of verdict, the pages.


def show_watch(reports: Sequence[CellReport], folders: Sequence[Path], added: int | None, pages: bool) -> None:
    """For people, on standard error; verdicts last."""
    from stitch.system.process import console
    from stitch.watch.report import headline, report_notes

    terminal = console()
    if added is not None:
        terminal.print(f"{added} new {'run' if added == 1 else 'runs'} in {folders[0]}", soft_wrap=True)
    # Of a plant the verdicts are enough; its page has the rest.
    for report in reports if len(reports) == 1 else ():
        terminal.print(_cell_table(report))
        for p in report.parameters:
            if p.follows:
                terminal.print(f"{p.name} follows {follows_text(p)}", soft_wrap=True)
    for report in reports:
        for note in report_notes(report):
            terminal.print(f"{report.name}: {note}", soft_wrap=True)
    for folder in folders if pages else ():
        terminal.print(f"  {folder / 'watch.html'}", soft_wrap=True)
    if pages and len(folders) > 1:
        terminal.print(f"  {folders[0].parent / 'plant.html'}", soft_wrap=True)
    for report in reports:
        terminal.print(headline(report), soft_wrap=True, style="bold")


def _cell_table(report: CellReport) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from stitch.units import rounded
    from stitch.watch.report import day_text, table_unit

    span = f"{day_text(report.first)} to {day_text(report.last)}"
    title = f"{report.name}: {report.sessions:,} sessions, {span}; calibration of {report.in_use} in use"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=0, pad_edge=False)
    for heading in ("parameter", "unit", "value", "sigma", "a day", "valid", "moved"):
        words = heading in ("parameter", "unit", "moved")
        table.add_column(heading, justify="left" if words else "right", no_wrap=heading != "moved")
    for p in report.parameters:
        factor, unit = table_unit(p.unit, report.length_unit)
        # A drift that is not known to be one is a dash.
        moves = abs(p.drift_per_day) > 3 * p.drift_sigma
        drift = rounded(factor * p.drift_per_day, factor * p.drift_sigma) if moves else "–"
        value = rounded(factor * p.value, factor * p.sigma / 10)
        table.add_row(
            p.name, unit, value, f"{factor * p.sigma:.2g}", drift, valid_text(report, p), moved_text(report, p)
        )
    return table


def follows_text(p: ParameterReport) -> str:
    """Channels that it follows, with its share."""
    from stitch.watch.report import size_text

    return ", ".join(f"{f.channel} ({size_text(f.per_unit, p.unit, f.sigma)} per unit)" for f in p.follows)


def moved_text(report: CellReport, p: ParameterReport) -> str:
    """The alarm that stands."""
    if p.alarm is None:
        return "–"
    beside = f" with {p.alarm.channel}" if p.alarm.channel else ""
    return f"{p.alarm.kind}{beside}, {report.run_names[p.alarm.since]}"


def valid_text(report: CellReport, p: ParameterReport) -> str:
    """Until when the calibration in use holds for it."""
    from stitch.watch.report import day_text

    if p.valid_until is None:
        return "holds"
    return "over" if p.valid_until <= report.last else day_text(p.valid_until)[:10]


# What `stitch watch` does: runs appended, cells judged, pages and metrics written.

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
    from stitch.system.process import steps
    from stitch.watch.history import known_run_hash, measured_at, open_history, read_record, use_calibration
    from stitch.watch.report import cell_report, dfq_text, report_document
    from stitch.watch.update import append_runs
    from stitch.writing.json_file import to_json

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
    from stitch.watch.report import cell_trend, openmetrics
    from stitch.writing.run_folder import call_entry_points

    for history, report, folder in zip(histories, reports, folders, strict=True):
        call_entry_points("stitch.watch_pages", cell_trend(history, report), folder / "watch.html")
        _write_text(openmetrics([report]), folder / "watch.prom")
    if len(reports) > 1:
        links = [(report, folder / "watch.html") for report, folder in zip(reports, folders, strict=True)]
        call_entry_points("stitch.plant_pages", links, folders[0].parent / "plant.html")


def _write_text(text: str, path: Path, encoding: str = "utf-8") -> None:
    from stitch.system.files import whole_file

    with whole_file(path) as file:
        file.write_bytes(text.encode(encoding))


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

    run_watch(folders, runs, add=add, at=at, in_use=in_use, tolerance=tolerance, page=page, dfq=dfq, as_json=as_json)


def _require_sense(
    add: bool, runs: list[Path], at: str, in_use: Path | None, dfq: Path | None, folders: list[Path]
) -> None:
    """Refuse options that do not go together."""
    if add and not runs:
        raise InputError("--add: no runs; to fix: name the cell first, then its runs: stitch watch CELL --add RUN")
    if at and len(runs) != 1:
        raise InputError("--at: says when one run was measured; to fix: name one RUN with --add")
    if len(folders) > 1 and (in_use is not None or dfq is not None):
        raise InputError("--in-use and --dfq: belong to one cell; to fix: name one")
    if dfq is not None and (dfq.suffix.lower() != ".dfq" or not dfq.parent.is_dir()):
        raise InputError(f"--dfq {dfq}: to fix: name a file that ends in .dfq, in a folder that exists")
    names = [folder.resolve().name for folder in folders]
    if len(set(names)) < len(names):
        raise InputError(f"two cells are named {max(names, key=names.count)!r}; to fix: name each once")
