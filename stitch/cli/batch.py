"""`stitch batch SESSION…`: many sessions, each a run of its own, on one process or many."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from uuid import uuid4

import typer

from stitch.cli.options import Json
from stitch.cli.terminal import emit
from stitch.errors import InputError, NoResultError

if TYPE_CHECKING:
    from stitch.batch.run_batch import BatchJob, SessionRow


# What `stitch batch` says: a line a session as it is finished, and a table at the end.

# Of more sessions than these the terminal shows only those that need somebody; the page has all.
_MOST = 100
_COLUMNS = ("session", "before", "one hand-eye", "registered", "noise", "worst view", "s")


def show_row(row: SessionRow, count: int, total: int) -> None:
    """One line on standard error."""
    from stitch.system.process import console

    if row.error is not None:
        told = f"no result: {row.error}"
    else:
        before = "finished before, " if row.skipped else ""
        told = f"{before}{_um(row.residual_um)} with one hand-eye, {_um(row.registered_um)} registered"
    console().print(f"{count} of {total}  {row.name}: {told}", soft_wrap=True)


def show_table(rows: Sequence[SessionRow]) -> None:
    """The table, and the reasons of those without a result."""
    from rich.table import Table

    from stitch.batch.run_batch import SessionRow
    from stitch.system.process import console

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
    from stitch.system.process import console

    for name in names:
        if (folder / name).exists():
            console().print(f"  {folder / name}", soft_wrap=True)


def _um(value: float | None) -> str:
    from stitch.units import length_text

    return "–" if value is None else length_text(value / 1e3, "mm", zeros=True)


# What `stitch batch` does: a job a session, and what is said of them.


def run_batch(
    sessions: list[Path], output: Path, workers: int, scheduler: str, *, force: bool, recording: bool, as_json: bool
) -> None:
    """Run sessions into a folder, tell each as it is finished, and all at the end.

    Raises:
        InputError, NoResultError: as `stitch batch` ends.
    """
    from stitch.batch.run_batch import run_jobs
    from stitch.system.process import console, steps

    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; to fix: name a folder for the runs with -o")
    jobs, stood = _batch_jobs(sessions, output, force, recording), output.exists()
    rows: dict[str, SessionRow] = {}
    try:
        # Whatever ends the loop ends the workers.
        with closing(run_jobs(jobs, workers, scheduler, console().print)) as coming:
            for row in steps("sessions", coming, len(jobs)):
                rows[row.name] = row
                show_row(row, len(rows), len(jobs))
    except KeyboardInterrupt:
        raise NoResultError(
            f"stopped with {len(rows)} of {len(jobs)} sessions told; what is finished is kept, and the same command "
            "goes on from there"
        ) from None
    if not stood and output.is_dir() and not any(output.iterdir()):
        # Workers claim their places before they read: where nothing came of it, nothing is left.
        output.rmdir()
    _finish_batch([rows[job.run.name] for job in jobs], output, as_json)


def _batch_jobs(sessions: list[Path], output: Path, force: bool, recording: bool) -> list[BatchJob]:
    """A job a session.

    Raises:
        InputError: two sessions, or a session and a file of the batch, would have the same place.
    """
    from stitch.batch.run_batch import DOCUMENT, PAGE, BatchJob

    names = [_session_name(path) for path in sessions]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise InputError(f"two of the sessions are named {twice!r}; run them with -o of their own")
    if taken := {DOCUMENT, PAGE} & set(names):
        raise InputError(f"a session is named {taken.pop()!r}, as a file of the batch is; give it another name")
    here, token = output.resolve(), uuid4().hex
    return [
        BatchJob(path.resolve(), here / name, token, force, recording)
        for path, name in zip(sessions, names, strict=True)
    ]


def _session_name(session: Path) -> str:
    """What the session is called; a session that cannot be read is refused when it is its turn."""
    from stitch.reading.session_folder import read_session_document as session_document
    from stitch.reading.session_folder import session_name

    try:
        file = session / "session.toml"
        return session_name(file, session_document(file))
    except InputError:
        return session.resolve().name


def _finish_batch(rows: list[SessionRow], output: Path, as_json: bool) -> None:
    """Tables, files, and how it ends.

    Raises:
        InputError, NoResultError: sessions have no result.
    """
    from stitch.batch.run_batch import DOCUMENT, PAGE, batch_document, batch_sentence, write_summary
    from stitch.system.process import console
    from stitch.writing.json_file import to_json

    failed = [row for row in rows if row.error is not None]
    if len(failed) < len(rows):
        write_summary(rows, output)
    if as_json:
        emit(to_json(batch_document(rows)))
    else:
        show_table(rows)
        console().print(batch_sentence(rows), soft_wrap=True, style="bold")
        show_files(output, (PAGE, DOCUMENT))
    if failed:
        kind = InputError if all(row.bad_input for row in failed) else NoResultError
        raise kind(f"{len(failed)} of {len(rows)} sessions have no result; their lines say why")


def batch(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Session folders.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where the runs go.")] = Path("runs"),
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes on this machine.")] = 1,
    scheduler: Annotated[
        str, typer.Option("--scheduler", metavar="tcp://…", help="Workers of a Dask scheduler that runs already.")
    ] = "",
    force: Annotated[
        bool, typer.Option("--force", help="Run finished sessions too, and replace runs of other sessions.")
    ] = False,
    recording: Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd.")] = True,
    as_json: Json = False,
) -> None:
    """Run many sessions; one that fails does not stop the others. Started again, it runs what is not finished.

    \b
    Examples:
      stitch batch blade-17 blade-18 blade-19 -o runs --workers 2
      stitch batch blade-* --scheduler tcp://10.0.0.5:8786
    """
    if scheduler and workers > 1:
        raise InputError("--workers and --scheduler: the scheduler has workers of its own; to fix: name one of the two")

    run_batch(sessions, output, workers, scheduler, force=force, recording=recording, as_json=as_json)
