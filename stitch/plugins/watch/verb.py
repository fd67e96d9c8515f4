"""`stitch.watch` and `stitch.batch`: what these commands do, from a program; many sessions on any pool or cluster."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from stitch.api.run import Run
from stitch.api.session import load_session
from stitch.api.verbs import run as stitch_run
from stitch.errors import InputError, StitchError
from stitch.output.result_document import result_document
from stitch.plugins.watch.batch.cluster import sessions_at_once
from stitch.plugins.watch.batch.run_batch import SessionRow, batch_document, failed_row, row_of_document
from stitch.plugins.watch.history import known_run_hash, measured_at, open_history, read_record
from stitch.plugins.watch.report import CellReport, cell_report
from stitch.plugins.watch.update import append_runs
from stitch.session.session import SessionData
from stitch.system.threads import share_cores
from stitch.system.values import Table


@dataclass(frozen=True, eq=False)
class Batch(Table, document="stitch.plugins.watch.verb:document_of_batch", table="sessions"):
    """Outcomes of many sessions, in their order: a run each, or why there is none.

    Example:
        >>> found = stitch.batch([session, other])
        >>> [run.session.name for run in found.runs if run]
        ['s', 'other']
        >>> sorted(found.to_pandas().columns)[:2]
        ['U_mm', 'U_mrad']
    """

    runs: tuple[Run | None, ...]
    outcomes: tuple[SessionRow, ...]

    @property
    def errors(self) -> dict[str, str]:
        """By name, why sessions have no run."""
        return {row.name: row.error for row in self.outcomes if row.error is not None}


def batch(
    sessions: Sequence[SessionData | Path | str], client: Any = None, *, effects: Sequence[str] = (), keep: bool = False
) -> Batch:
    """Stitch many sessions, each for itself, and return their runs; one that fails does not stop the others.

    Args:
        sessions: in memory, or folders that the workers can read.
        client: what has `submit`: a `concurrent.futures` pool or a Dask client; None: this process.
        effects, keep: as of `stitch.run`.

    Returns:
        `runs`, None where there is none, `errors` by name, and a table: lengths in µm, U in mm and mrad.

    Raises:
        InputError: `client` has no `submit`.

    Example:
        >>> stitch.batch([session, folder / "nowhere"]).errors
        {'nowhere': '...nowhere...'}
    """
    at_once = 1 if client is None else sessions_at_once(client)
    work = partial(_run_one, effects=tuple(effects), keep=keep, at_once=at_once)
    if client is None:
        ended = [work(session) for session in sessions]
    elif not hasattr(client, "submit"):
        raise InputError(f"batch: client is a {type(client).__name__}; to fix: pass a pool or a Dask client")
    else:
        # A Dask client takes what is submitted twice for one task, unless it is told.
        options = {"pure": False} if hasattr(client, "scheduler_info") else {}
        ended = [future.result() for future in [client.submit(work, session, **options) for session in sessions]]
    return Batch(tuple(run for run, _ in ended), tuple(row for _, row in ended))


def watch(
    cell: Path | str,
    runs: Sequence[Path | str] = (),
    *,
    at: str = "",
    in_use: Path | str | None = None,
    tolerance: float | None = None,
) -> CellReport:
    """Find what moves in a cell from day to day, as `stitch watch` does.

    Args:
        cell: folder of its history; it is begun with the first runs.
        runs: folders of runs that join the history.
        at: when they were measured, ISO 8601; "": as their files say.
        in_use: folder of the run whose calibration the cell uses from now on.
        tolerance: by which the mount may displace the part, length_unit; None: U of the calibration in use.

    Returns:
        `alarms`, `recalibrate_before` (s since 1970) and `parameters`, in rad and length_unit.

    Raises:
        InputError: no cell, or a folder that is no run.
        NoResultError: another process holds the history for long.

    Example:
        >>> saved = run.save(folder / "monday", recording=False)
        >>> stitch.watch(folder / "cell-7", [saved]).sessions
        1
    """
    time = measured_at(at) if at else None
    records = [read_record(Path(run), time) for run in runs]
    with ExitStack() as stack:
        history = stack.enter_context(open_history(Path(cell), new=bool(records)))
        used = None if in_use is None else known_run_hash(history, Path(in_use), records)
        append_runs(history, records)
        if used is not None:
            with history.writing():
                history.state({"in_use": used})
        return cell_report(history, tolerance)


def document_of_batch(batch: Batch) -> dict[str, Any]:
    """Return batch.json of runs in memory."""
    return batch_document(batch.outcomes)


def _run_one(
    session: SessionData | Path | str, effects: Sequence[str], keep: bool, at_once: int
) -> tuple[Run | None, SessionRow]:
    """Return the run of a session and its row; whatever befalls it becomes part of the row."""
    name = session.name if isinstance(session, SessionData) else Path(session).name
    if at_once > 1:
        share_cores(at_once)
    try:
        loaded = session if isinstance(session, SessionData) else load_session(session)
        run = stitch_run(loaded, effects=effects, keep=keep)
        return run, row_of_document(result_document(run), str(loaded.path), name, U=run.hand_eye.U)
    except StitchError as error:
        return None, failed_row(str(session), name, error)
