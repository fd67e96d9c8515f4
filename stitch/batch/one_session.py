"""One session of a batch on whichever process it comes to: run once, or found where it has been run."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from stitch.batch.finished import finished_batch, session_content_hash, write_mark
from stitch.batch.job import BatchJob
from stitch.batch.session_row import SessionRow, failed_row, finished_row
from stitch.errors import BusyError
from stitch.pipeline import run
from stitch.reading.session_folder import load_session
from stitch.runs.tee import RecorderGroup
from stitch.system.threads import share_cores
from stitch.system.whole_folder import claim_folder
from stitch.writing import run_folder
from stitch.writing.recordings import recordings
from stitch.writing.run_contents import require_free

# A worker that was given up may still be at work on a session: its successor waits for it, this long (s).
LOCK_WAIT_SECONDS = 3600.0
_RETRY_SECONDS = 0.5


def run_session(job: BatchJob) -> SessionRow:
    """Run a session into its folder unless its run stands there; what goes wrong becomes part of the answer."""
    share_cores(job.at_once)
    try:
        require_free(job.run, [job.session], job.force)
        with _locked_folder(job.run):
            content = session_content_hash(job.session)
            batch = finished_batch(job, content)
            if batch is None:
                _run_job(job, content)
            # A worker may die between a run and its answer; the next finds a run of this batch.
            return finished_row(job.session, job.run, skipped=batch not in (None, job.batch))
    except Exception as error:  # whatever befalls one session, the others go on
        return failed_row(job.session, job.run, error)


def _run_job(job: BatchJob, content: str | None) -> None:
    session = load_session(job.session)
    with run_folder.new_folder(job.run, [job.session], job.force) as scratch:
        result = run(session, recorder=RecorderGroup(recordings(scratch) if job.recording else []))
        run_folder.write_with_page(result, scratch)
        write_mark(job, content, scratch)


@contextmanager
def _locked_folder(folder: Path) -> Iterator[None]:
    """Hold the folder as its only writer, after whoever holds it now."""
    until = time.monotonic() + LOCK_WAIT_SECONDS
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(claim_folder(folder))
                break
            except BusyError:
                if time.monotonic() > until:
                    raise
                time.sleep(_RETRY_SECONDS)
        yield
