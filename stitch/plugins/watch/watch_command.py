"""`stitch watch CELL`: what moves in a cell, since when, until when the calibration in use holds."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import Json, require_tolerance
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, say, show_table, stdout_for_results
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.plugins.watch.history import History
    from stitch.plugins.watch.report import CellReport, ParameterReport

_DRIFTS = 3  # exit code where something drifts


@stdout_for_results
def watch(
    cells: Annotated[list[Path], typer.Argument(metavar="CELL...", help="Folder of a cell; after --add, its runs.")],
    add: Annotated[bool, typer.Option("--add", help="CELL RUN...: append runs to the history of the cell.")] = False,
    at: Annotated[str, typer.Option("--at", metavar="TIME", help="With --add RUN: when it was measured.")] = "",
    in_use: Annotated[
        Path | None, typer.Option("--in-use", metavar="RUN", help="Run whose calibration the cell uses from now on.")
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option("--tolerance", help="By which the mount may displace the part; default: U of the calibration."),
    ] = None,
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
    from stitch.output.json_file import to_json
    from stitch.plugins.watch.exported import dfq_text, report_document
    from stitch.plugins.watch.history import known_run_hash, measured_at, open_history, read_record
    from stitch.plugins.watch.report import cell_report
    from stitch.plugins.watch.update import append_runs
    from stitch.system.process import steps

    require_tolerance(tolerance)
    folders, runs = (cells[:1], cells[1:]) if add else (cells, [])
    _require_sense(add, runs, at, in_use, dfq, folders)
    records = [read_record(run, measured_at(at) if at else None) for run in steps("runs", runs)]
    reports: list[CellReport] = []
    with show_activity("watching: judging the history"), ExitStack() as stack:
        histories = [stack.enter_context(open_history(folder, new=add)) for folder in folders]
        used = None if in_use is None else known_run_hash(histories[0], in_use, records)
        added = append_runs(histories[0], records) if add else None
        if used is not None:
            with histories[0].writing():
                histories[0].state({"in_use": used})
        reports = [cell_report(history, tolerance) for history in histories]
        if page:
            _write_pages(histories, reports, folders)
        if dfq is not None:
            _write_text(dfq_text(histories[0], reports[0]), dfq, encoding="utf-8-sig")
    if as_json:
        documents = [report_document(report) for report in reports]
        emit(to_json(documents[0] if len(documents) == 1 else documents))
    else:
        _show_watch(reports, folders, added, page)
    if any(report.alarms for report in reports):
        raise typer.Exit(_DRIFTS)


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


def _write_pages(histories: list[History], reports: list[CellReport], folders: list[Path]) -> None:
    """Write the page and the metrics of every cell, and beside the first the page of all."""
    from stitch.output.run_folder import call_entry_points
    from stitch.plugins.watch.exported import openmetrics
    from stitch.plugins.watch.report import cell_trend

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


def _show_watch(reports: list[CellReport], folders: list[Path], added: int | None, pages: bool) -> None:
    """Print a table of one cell, notes, and the verdicts last; of a plant the verdicts are enough, its page has all."""
    from stitch.numerics.units import covariate_unit
    from stitch.plugins.watch.report import headline, report_notes, size_text

    if added is not None:
        say(f"{added} new {'run' if added == 1 else 'runs'} in {folders[0]}")
    for report in reports if len(reports) == 1 else ():
        _show_cell(report)
        for p in report.parameters:
            if p.follows:
                told = ", ".join(
                    f"{f.channel} ({size_text(f.per_unit, p.unit, f.sigma)} per {covariate_unit(f.channel) or 'unit'})"
                    for f in p.follows
                )
                say(f"{p.name} follows {told}")
    for report in reports:
        for note in report_notes(report):
            say(f"{report.name}: {note}")
    for folder in folders if pages else ():
        say(f"  {folder / 'watch.html'}")
    if pages and len(folders) > 1:
        say(f"  {folders[0].parent / 'plant.html'}")
    for report in reports:
        say(headline(report), bold=True)


def _show_cell(report: CellReport) -> None:
    from stitch.numerics.units import rounded
    from stitch.plugins.watch.report import day_text, sessions_text, table_unit

    rows = []
    for p in report.parameters:
        factor, unit = table_unit(p.unit, report.length_unit)
        # A drift that is not known to be one is a dash.
        moves = abs(p.drift_per_day) > 3 * p.drift_sigma
        drift = rounded(factor * p.drift_per_day, factor * p.drift_sigma) if moves else "–"
        value = rounded(factor * p.value, factor * p.sigma / 10)
        sigma = f"{factor * p.sigma:.2g}"
        rows.append((p.name, unit, value, sigma, drift, _valid_text(report, p), _moved_text(report, p)))
    span = f"{day_text(report.first)} to {day_text(report.last)}"
    show_table(
        f"{report.name}: {sessions_text(report)}, {span}; calibration of {report.in_use} in use",
        ("parameter", "unit", "value", "sigma", "a day", "valid", "moved"),
        rows,
        words=("parameter", "unit", "moved"),
    )


def _moved_text(report: CellReport, p: ParameterReport) -> str:
    """Return the alarm that stands."""
    if p.alarm is None:
        return "–"
    beside = f" with {p.alarm.channel}" if p.alarm.channel else ""
    return f"{p.alarm.kind}{beside}, {report.run_names[p.alarm.since]}"


def _valid_text(report: CellReport, p: ParameterReport) -> str:
    """Return until when the calibration in use holds for a parameter."""
    from stitch.plugins.watch.report import day_text

    if p.too_uncertain:
        return "not known"
    if p.valid_until is None:
        return "holds"
    return "over" if p.valid_until <= report.last else day_text(p.valid_until)[:10]
