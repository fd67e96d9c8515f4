"""Whether a session has been run already: its run folder says of which content it is."""

import csv
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stitch.batch.job import BatchJob
from stitch.errors import InputError
from stitch.reading.session_hash import UNKNOWN, content_hash, measured_files
from stitch.reading.toml_file import read_toml
from stitch.stored.run_documents import read_ledger
from stitch.system.whole_file import whole_file
from stitch.writing.run_contents import sessions_in

MARK = "batch-mark.json"
_FORMAT = "stitch-batch-mark/1"


def session_content_hash(session: Path) -> str | None:
    """A hash of all that a run reads of a session: tables, clouds, and the files that session.toml names.

    None where they cannot be read: such a session is never finished.
    """
    session = session.resolve()
    try:
        named = [session / text for text in _document_texts(read_toml(session / "session.toml", ""))]
        files = [*measured_files(session), *(file for file in named if file.is_file())]
    except (OSError, ValueError, csv.Error, InputError):
        return None
    found = content_hash(Path(session.anchor), files)
    return None if found == UNKNOWN else found


def write_mark(job: BatchJob, content: str | None, folder: Path) -> None:
    """Say in a folder that becomes the run's of which content it is; both are there at once."""
    told = {"format": _FORMAT, "batch": job.batch, "content": content, "began_with": _first_step_hash(folder)}
    with whole_file(folder / MARK) as file:
        file.write_text(json.dumps(told) + "\n", encoding="utf-8")


def finished_batch(job: BatchJob, content: str | None) -> str | None:
    """The batch that has run a session, if the folder holds a run of this very content; effects may have joined it.

    Of a batch that runs all again, only what it has run itself is finished.
    """
    if content is None or sessions_in(job.run) != [str(job.session.resolve())]:
        return None
    try:
        told = json.loads((job.run / MARK).read_text(encoding="utf-8"))
        # A later `stitch run` leaves the mark, and begins the history of the model anew.
        own = told["began_with"] == _first_step_hash(job.run) and told["format"] == _FORMAT
        whole = own and told["content"] == content and (not job.force or told["batch"] == job.batch)
        return str(told["batch"]) if whole else None
    except (OSError, ValueError, LookupError, TypeError, InputError):
        return None


def _first_step_hash(folder: Path) -> str:
    """A hash of the numbers with which the history of the model begins; remarks may join it later."""
    first = read_ledger(folder)[0]
    numbers = [first[key] for key in ("hand_eye", "residual_rms", "heldout_rms", "noise_floor")]
    return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()[:16]


def _document_texts(value: Any) -> Iterator[str]:
    """All texts of a document."""
    if isinstance(value, str) and value and "\0" not in value:
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _document_texts(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _document_texts(inner)
