"""What people state of a cell: which calibration it uses, and when a run was measured."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from stitch.errors import InputError
from stitch.watch.history import History
from stitch.watch.read_record import read_record
from stitch.watch.run_record import RunRecord


def use_calibration(history: History, run_hash: str) -> None:
    """From now on the cell uses the calibration of this run."""
    with history.writing():
        history.state({"in_use": run_hash})


def known_run_hash(history: History, run: Path, added: Sequence[RunRecord]) -> str:
    """The hash of a run that is in the history, or will be.

    Raises:
        InputError: it is not.
    """
    run_hash = read_record(run).run_hash
    known = history.sql("SELECT 1 FROM runs WHERE run_hash = ?", run_hash)
    if not known and run_hash not in {record.run_hash for record in added}:
        raise InputError(f"{run}: is not in the history of {history.folder}; to fix: append it with --add first")
    return run_hash


def measured_at(text: str) -> float:
    """Seconds since 1970 of an ISO 8601 time; without a zone it is UTC.

    Raises:
        InputError: no such time.
    """
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"--at {text}: no time; to fix: write 2026-03-01T06:30+01:00") from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
