"""What people state of a cell: which calibration it uses, and when a run was measured."""

from datetime import UTC, datetime
from pathlib import Path

from stitch.errors import InputError
from stitch.watch.history import History
from stitch.watch.read_record import read_record


def use(history: History, run: Path) -> None:
    """From now on the cell uses the calibration of this run.

    Raises:
        InputError: the run is not in the history.
    """
    record = read_record(run)
    with history.writing():
        if not history.sql("SELECT 1 FROM runs WHERE run_hash = ?", record.run_hash):
            raise InputError(f"{run}: is not in the history of {history.folder}; to fix: append it with --add first")
        history.state({"in_use": record.run_hash})


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
