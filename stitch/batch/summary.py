"""What a batch leaves beside its runs: batch.json for programs, batch.html for people."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stitch.batch.session_row import SessionRow
from stitch.writing.json_file import write_json
from stitch.writing.run_folder import call_entry_points

DOCUMENT, PAGE = "batch.json", "batch.html"
BATCH_FORMAT = "stitch-batch/1"


def batch_document(rows: Sequence[SessionRow]) -> dict[str, Any]:
    """batch.json as a dictionary: how many, and a row a session; lengths in µm."""
    failed = sum(row.error is not None for row in rows)
    skipped = sum(row.skipped for row in rows)
    return {
        "format": BATCH_FORMAT,
        "done": len(rows) - failed - skipped,
        "skipped": skipped,
        "failed": failed,
        "sessions": [asdict(row) for row in rows],
    }


def write_summary(rows: Sequence[SessionRow], folder: Path) -> None:
    """Write both into the folder of the runs, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(batch_document(rows), folder / DOCUMENT)
    call_entry_points("stitch.batch_pages", rows, folder / PAGE)


def batch_sentence(rows: Sequence[SessionRow]) -> str:
    """How many are run, were finished before, have failed."""
    counts = batch_document(rows)
    told = [f"{counts[key]} {words}" for key, words in _WORDS.items() if counts[key]]
    return f"{len(rows)} {'session' if len(rows) == 1 else 'sessions'}: {', '.join(told) or 'nothing to do'}."


_WORDS = {"done": "run", "skipped": "finished before", "failed": "without a result"}
