"""What `stitch batch` says: a line a session as it is finished, and a table at the end."""

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from stitch.batch.session_row import SessionRow
from stitch.system.console import console
from stitch.units import length_text

# Of more sessions than these the terminal shows only those that need somebody; the page has all.
_MOST = 100
_COLUMNS = ("session", "before", "one hand-eye", "registered", "noise", "worst view", "s")


def show_row(row: SessionRow, count: int, total: int) -> None:
    """One line on standard error."""
    if row.error is not None:
        told = f"no result: {row.error}"
    else:
        before = "finished before, " if row.skipped else ""
        told = f"{before}{_um(row.residual_um)} with one hand-eye, {_um(row.registered_um)} registered"
    console().print(f"{count} of {total}  {row.name}: {told}", soft_wrap=True)


def show_table(rows: Sequence[SessionRow]) -> None:
    """The table, and the reasons of those without a result."""
    terminal, table = console(), Table()
    for heading in _COLUMNS:
        table.add_column(heading, justify="left" if heading in ("session", "worst view") else "right")
    shown = sorted(rows, key=SessionRow.urgency)[:_MOST] if len(rows) > _MOST else rows
    for row in shown:
        lengths = [_um(x) for x in (row.coarse_um, row.residual_um, row.registered_um, row.noise_floor_um)]
        worst = "–" if row.worst_view is None else f"{row.worst_view} {_um(row.worst_view_um)}"
        table.add_row(row.name, *lengths, worst, "–" if row.seconds is None else f"{row.seconds:.1f}")
    terminal.print(table)
    if len(shown) < len(rows):
        terminal.print(f"The {_MOST} of {len(rows)} that need somebody first; the page has all.")
    for row in rows:
        if row.error is not None:
            terminal.print(f"{row.session}: {row.error}", soft_wrap=True)


def show_files(folder: Path, names: Sequence[str]) -> None:
    """Where to look."""
    for name in names:
        if (folder / name).exists():
            console().print(f"  {folder / name}", soft_wrap=True)


def _um(value: float | None) -> str:
    return "–" if value is None else length_text(value / 1e3, "mm", zeros=True)
