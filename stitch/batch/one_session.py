"""One session of a batch on whichever process it comes to: run once, or found where it has been run."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from stitch.batch.finished import content_of, finished, mark
from stitch.batch.job import Job
from stitch.batch.session_row import SessionRow, failed_row, row_of
from stitch.errors import BusyError
from stitch.pipeline import run
from stitch.reading.session_folder import load_session
from stitch.runs.tee import Tee
from stitch.system.threads import share_cores
from stitch.system.whole_folder import claimed
from stitch.writing import run_folder
from stitch.writing.recordings import recordings
from stitch.writing.run_contents import require_free

# A worker that was given up may still be at work on a session: its successor waits for it, this long (s).
PATIENCE = 3600.0
_STEP = 0.5


def run_session(job: Job) -> SessionRow:
    """Run a session into its folder unless its run stands there; what goes wrong becomes part of the answer."""
    share_cores(job.at_once)
    try:
        require_free(job.run, [job.session], job.force)
        with _held(job.run):
            content = content_of(job.session)
            batch = finished(job, content)
            if batch is None:
                _stitch(job, content)
            # A worker may die between a run and its answer; the next finds a run of this batch.
            return row_of(job.session, job.run, skipped=batch not in (None, job.batch))
    except Exception as error:  # whatever befalls one session, the others go on
        return failed_row(job.session, job.run, error)


def _stitch(job: Job, content: str | None) -> None:
    session = load_session(job.session)
    with run_folder.new_folder(job.run, [job.session], job.force) as scratch:
        result = run(session, recorder=Tee(recordings(scratch) if job.recording else []))
        run_folder.write_with_page(result, scratch)
        mark(job, content, scratch)


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Hold the folder as its only writer, after whoever holds it now."""
    until = time.monotonic() + PATIENCE
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(claimed(folder))
                break
            except BusyError:
                if time.monotonic() > until:
                    raise
                time.sleep(_STEP)
        yield
