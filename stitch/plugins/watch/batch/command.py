"""`stitch batch SESSION…`: many sessions, each a run of its own, on one process or many."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal
from uuid import uuid4

import typer

from stitch.cli.options import Json, bytes_of
from stitch.cli.terminal import emit, say, show_files, show_table, stdout_for_results
from stitch.errors import InputError, NoResultError

if TYPE_CHECKING:
    from stitch.plugins.watch.batch.run_batch import BatchJob, SessionRow

_ALARMS = 3  # exit code where all have a run, and some a doubt about the session as a whole
# Of more sessions than these the terminal shows only those that need somebody; the page has all.
_MOST = 100


@stdout_for_results
def batch(
    sessions: Annotated[list[str], typer.Argument(metavar="SESSION...", help="Session folders, also s3://…")],
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Where the runs go.")] = "runs",
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes on this machine.")] = 1,
    scheduler: Annotated[
        str, typer.Option("--scheduler", metavar="tcp://…", help="Workers of a Dask scheduler that runs already.")
    ] = "",
    force: Annotated[
        bool, typer.Option("--force", help="Run finished sessions too, and replace runs of other sessions.")
    ] = False,
    recording: Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd.")] = True,
    store: Annotated[
        Literal["all", "small"], typer.Option(help="Keep all of a run, or its numbers alone (20 kB).")
    ] = "all",
    seconds: Annotated[
        float, typer.Option("--session-seconds", min=0.0, metavar="S", help="End a session after so long; 0: never.")
    ] = 0.0,
    memory: Annotated[
        str | None, typer.Option("--session-memory", metavar="SIZE", help="End a session beyond so much, such as 4GB.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Run many sessions; one that fails does not stop the others. Started again, it runs what is not finished.

    \b
    Examples:
      stitch batch blade-17 blade-18 blade-19 -o runs --workers 2
      stitch batch blade-* --scheduler tcp://10.0.0.5:8786
      stitch batch blade-* --store small --session-seconds 600 --session-memory 4GB
    """
    from stitch.plugins.watch.batch.run_batch import is_remote, put_summary

    if scheduler and workers > 1:
        raise InputError("--workers and --scheduler: the scheduler has workers of its own; to fix: name one of the two")
    if any(is_remote(place) != is_remote(output) for place in sessions):
        raise InputError(
            f"{output}: sessions of a store beside some of this disk; to fix: name sessions and -o of stores"
        )
    if memory and find_spec("resource") is None:
        raise InputError("--session-memory: Windows bounds no process; to fix: leave it away, or use `--store small`")
    bounds: dict[str, Any] = {
        "small": store == "small",
        "seconds": seconds,
        "memory": int(bytes_of(memory, "--session-memory") or 0),
    }
    if is_remote(output):
        jobs = [replace(job, **bounds) for job in _stored_jobs(sessions, output, force, recording)]
        with TemporaryDirectory() as scratch:
            folder = Path(scratch)
            try:
                _run_all(jobs, folder, workers, scheduler, as_json)
            finally:
                put_summary(folder, output)
        return
    folder = Path(output)
    jobs = [replace(job, **bounds) for job in _batch_jobs([Path(s) for s in sessions], folder, force, recording)]
    _run_all(jobs, folder, workers, scheduler, as_json)


def _run_all(jobs: list[BatchJob], output: Path, workers: int, scheduler: str, as_json: bool) -> None:
    """Run the jobs, and write how it ended."""
    from stitch.plugins.watch.batch.run_batch import run_jobs
    from stitch.system.process import steps

    stood = output.exists()
    rows: dict[str, SessionRow] = {}
    tell = partial(say, stream=sys.stderr)
    try:
        # Whatever ends the loop ends the workers.
        with closing(run_jobs(jobs, workers, scheduler, tell)) as coming:
            for row in steps("sessions", coming, len(jobs)):
                rows[row.name] = row
                tell(f"{len(rows)} of {len(jobs)}  {row.name}: {_row_text(row)}")
    except KeyboardInterrupt:
        raise NoResultError(
            f"stopped after {len(rows)} of {len(jobs)} sessions; to fix: start the same command again, it goes on from "
            "there"
        ) from None
    if not stood and output.is_dir() and not any(output.iterdir()):
        # Workers claim their places before they read: where nothing came of it, nothing is left.
        output.rmdir()
    _finish_batch([rows[job.name] for job in jobs], output, as_json)


def _batch_jobs(sessions: list[Path], output: Path, force: bool, recording: bool) -> list[BatchJob]:
    """Return a job for each session; where two have one name, the runs lie as the sessions do.

    Raises:
        InputError: two sessions, or a session and a file of the batch, would have the same place; no folder for runs.
    """
    from stitch.plugins.watch.batch.run_batch import DOCUMENT, PAGE, TABLE, BatchJob

    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; to fix: name a folder for the runs with -o")

    names = [_session_name(path) for path in sessions]
    if len(set(names)) < len(names):
        names = _mirrored_names(sessions)
    if taken := {DOCUMENT, PAGE, TABLE} & set(names):
        raise InputError(
            f"a session is named {taken.pop()!r}, as a file of the batch is; to fix: name it otherwise in session.toml"
        )
    here, token = output.resolve(), uuid4().hex
    return [
        BatchJob(path.resolve(), here / name, token, force, recording, place=name)
        for path, name in zip(sessions, names, strict=True)
    ]


def _stored_jobs(sessions: list[str], output: str, force: bool, recording: bool) -> list[BatchJob]:
    """Return a job for each session of a store; the runs lie as the sessions do."""
    from stitch.plugins.watch.batch.run_batch import BatchJob

    places = [Path(session.partition("://")[2]) for session in sessions]
    names = [place.name for place in places]
    if len(set(names)) < len(names):
        names = _mirrored_names(places)
    token = uuid4().hex
    return [
        BatchJob(Path(name), Path(name), token, force, recording, 1, name, source.rstrip("/"), f"{output}/{name}")
        for name, source in zip(names, sessions, strict=True)
    ]


def _mirrored_names(sessions: list[Path]) -> list[str]:
    """Return the paths of the sessions below the folder that holds them all.

    Raises:
        InputError: one is named twice, or lies in another.
    """
    places = [path.resolve() for path in sessions]
    for place in places:
        if places.count(place) > 1 or any(place in other.parents for other in places):
            raise InputError(f"{place}: is named twice, or holds another session; to fix: name each session once")
    common = Path(os.path.commonpath(places))
    return [place.relative_to(common).as_posix() for place in places]


def _session_name(session: Path) -> str:
    """Return what a session is called; one that cannot be read is refused when it is its turn."""
    from stitch.session.reading.session_toml import read_session_document, session_name

    try:
        file = session / "session.toml"
        return session_name(file, read_session_document(file))
    except InputError:
        return session.resolve().name


def _finish_batch(rows: list[SessionRow], output: Path, as_json: bool) -> None:
    """Write the files, print tables and how it ended.

    Raises:
        InputError, NoResultError: sessions have no result.
    """
    from stitch.output.json_file import to_json
    from stitch.plugins.watch.batch.run_batch import DOCUMENT, PAGE, batch_document, batch_sentence, write_summary

    failed = [row for row in rows if row.error is not None]
    if len(failed) < len(rows):
        write_summary(rows, output)
    if as_json:
        emit(to_json(batch_document(rows)))
    else:
        _show_rows(rows, batch_sentence(rows))
        show_files(output, (PAGE, DOCUMENT))
    if failed:
        kind = InputError if all(row.bad_input for row in failed) else NoResultError
        raise kind(f"no result of {len(failed)} of {len(rows)} sessions; to fix: see the line of each above")
    if any(row.doubts for row in rows):
        raise typer.Exit(_ALARMS)


def _show_rows(rows: Sequence[SessionRow], sentence: str) -> None:
    """Print how it ended, the table, and the reasons of those without a result."""
    from stitch.plugins.watch.batch.run_batch import SessionRow

    say(sentence, bold=True)
    shown = sorted(rows, key=SessionRow.urgency)[:_MOST] if len(rows) > _MOST else rows
    cells = []
    for row in shown:
        lengths = [_um(x) for x in (*row.steps_um, row.noise_floor_um)]
        worst = "–" if row.worst_view is None else f"{row.worst_view} {_um(row.worst_view_um)}"
        cells.append((row.name, *lengths, worst, "–" if row.seconds is None else f"{row.seconds:.1f}"))
    headings = ("session", "before", "one hand-eye", "registered", "noise", "worst view", "s")
    show_table("Distance between the views, mean over the same pairs", headings, cells, words=("session", "worst view"))
    if len(shown) < len(rows):
        say(f"The {_MOST} of {len(rows)} that need somebody first; the page has all.")
    for row in rows:
        if row.error is not None:
            say(f"{row.session}: {row.error}", stream=sys.stderr)
        for doubt in row.doubts:
            say(f"{row.name}: {doubt}")


def _row_text(row: SessionRow) -> str:
    if row.error is not None:
        return f"no result: {row.error}"
    before = "finished before, " if row.skipped else ""
    return f"{before}{_um(row.residual_um)} with one hand-eye, {_um(row.registered_um)} registered"


def _um(value: float | None) -> str:
    from stitch.numerics.units import length_text

    return "–" if value is None else length_text(value / 1e3, "mm", zeros=True)
