"""What `stitch watch` says for people: a table a cell, one line of verdict, the pages."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from stitch.system.console import console
from stitch.watch.cell_report import CellReport, ParameterReport
from stitch.watch.sentences import day_text, headline, notes, size_text


def show(reports: Sequence[CellReport], folders: Sequence[Path], added: int | None, pages: bool) -> None:
    """For people, on standard error; verdicts last."""
    terminal = console()
    if added is not None:
        terminal.print(f"{added} new {'run' if added == 1 else 'runs'} in {folders[0]}", soft_wrap=True)
    for report in reports:
        terminal.print(_table(report))
        for p in report.parameters:
            if p.follows:
                terminal.print(f"{p.name} follows {follows_text(p)}", soft_wrap=True)
        for note in notes(report):
            terminal.print(note, soft_wrap=True)
    for folder in folders if pages else ():
        terminal.print(f"  {folder / 'watch.html'}", soft_wrap=True)
    if pages and len(folders) > 1:
        terminal.print(f"  {folders[0].parent / 'plant.html'}", soft_wrap=True)
    for report in reports:
        terminal.print(headline(report), soft_wrap=True, style="bold")


def _table(report: CellReport) -> Table:
    span = f"{day_text(report.first)} to {day_text(report.last)}"
    title = f"{report.name}: {report.sessions:,} sessions, {span}; calibration of {report.in_use} in use"
    table = Table(title=title, title_justify="left")
    for heading in ("parameter", "value", "sigma", "a day", "valid until", "moved"):
        table.add_column(heading, justify="left" if heading in ("parameter", "moved") else "right", no_wrap=True)
    for p in report.parameters:
        table.add_row(p.name, *numbers_of(p), valid_text(report, p), moved_text(report, p))
    return table


def numbers_of(p: ParameterReport) -> tuple[str, str, str]:
    """Value, sigma and drift a day; a drift that is not known to be one is a dash."""
    moves = np.isfinite(p.drift_sigma) and abs(p.drift_per_day) > 3 * p.drift_sigma
    drift = size_text(p.drift_per_day, p.unit, p.drift_sigma) if moves else "–"
    return size_text(p.value, p.unit, p.sigma), size_text(p.sigma, p.unit), drift


def follows_text(p: ParameterReport) -> str:
    """Channels that it follows, with its share."""
    return ", ".join(f"{f.channel} ({size_text(f.per_unit, p.unit, f.sigma)} per unit)" for f in p.follows)


def moved_text(report: CellReport, p: ParameterReport) -> str:
    """The alarm that stands."""
    if p.alarm is None:
        return "–"
    beside = f" with {p.alarm.channel}" if p.alarm.channel else ""
    return f"{p.alarm.kind}{beside} since {report.run_names[p.alarm.since]}"


def valid_text(report: CellReport, p: ParameterReport) -> str:
    """Until when the calibration in use holds for it."""
    if p.valid_until is None:
        return "holds"
    return "over" if p.valid_until <= report.last else day_text(p.valid_until)
