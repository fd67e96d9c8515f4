"""What `stitch watch` says for people: a table a cell, one line of verdict, the pages."""

from collections.abc import Sequence
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table

from stitch.system.console import console
from stitch.units import rounded
from stitch.watch.cell_report import CellReport, ParameterReport
from stitch.watch.sentences import day_text, headline, report_notes, size_text
from stitch.watch.table_units import table_unit


def show_watch(reports: Sequence[CellReport], folders: Sequence[Path], added: int | None, pages: bool) -> None:
    """For people, on standard error; verdicts last."""
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
    return ", ".join(f"{f.channel} ({size_text(f.per_unit, p.unit, f.sigma)} per unit)" for f in p.follows)


def moved_text(report: CellReport, p: ParameterReport) -> str:
    """The alarm that stands."""
    if p.alarm is None:
        return "–"
    beside = f" with {p.alarm.channel}" if p.alarm.channel else ""
    return f"{p.alarm.kind}{beside}, {report.run_names[p.alarm.since]}"


def valid_text(report: CellReport, p: ParameterReport) -> str:
    """Until when the calibration in use holds for it."""
    if p.valid_until is None:
        return "holds"
    return "over" if p.valid_until <= report.last else day_text(p.valid_until)[:10]
