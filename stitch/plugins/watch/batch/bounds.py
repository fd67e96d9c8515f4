"""A session of a batch in a process of its own, which ends after so many seconds or beyond so much memory.

A worker's thread cannot be interrupted, and one session that takes all memory takes the worker with it.
"""

import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace
from threading import Thread

from stitch.errors import NoResultError
from stitch.plugins.watch.batch.run_batch import BatchJob, SessionRow, failed_row, run_session

_PROGRAM = "from stitch.plugins.watch.batch.bounds import main; main()"
# What Python, the allocators of C and C++, and OpenBLAS say where memory ends.
_NO_MEMORY = ("memoryerror", "cannot allocate", "not enough memory", "bad_alloc", "memory allocation")


def run_bounded(job: BatchJob) -> SessionRow:
    """Return the row of a session that is run in its own process within the bounds of the job.

    Memory is what the process itself may hold (RLIMIT_DATA), files that it maps not counted.
    """
    try:
        ended = subprocess.run(
            [sys.executable, "-P", "-c", _PROGRAM],
            input=pickle.dumps(job),
            capture_output=True,
            timeout=job.seconds or None,
            check=False,
        )
    except subprocess.TimeoutExpired:
        late = NoResultError(f"took more than {job.seconds:g} s; to fix: give it longer, or thin its scans")
        return failed_row(str(job.session), job.name, late)
    row: SessionRow | None = pickle.loads(ended.stdout) if ended.returncode == 0 else None
    said = ended.stderr.decode("utf-8", "replace") if row is None else row.error or ""
    bad_input = row is not None and row.bad_input
    if job.memory and not bad_input and any(words in said.lower() for words in _NO_MEMORY):
        full = NoResultError(f"needs more than {job.memory / 1e9:g} GB; to fix: give it more, or thin its scans")
        return failed_row(str(job.session), job.name, full)
    if row is not None:
        return row
    end = f"code {ended.returncode}" if ended.returncode > 0 else signal.strsignal(-ended.returncode)
    last = " ".join(said.split()[-20:]) or "it said nothing"
    return failed_row(str(job.session), job.name, NoResultError(f"its process ended with {end}: {last}"))


def main() -> None:
    """Run the job that stands on standard input, and write its row to standard output, which nothing else reaches."""
    with os.fdopen(os.dup(1), "wb") as answer:
        os.dup2(2, 1)
        Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
        job: BatchJob = pickle.loads(sys.stdin.buffer.read())
        if job.memory:
            import resource  # not on Windows

            resource.setrlimit(resource.RLIMIT_DATA, (job.memory, job.memory))
        answer.write(pickle.dumps(run_session(replace(job, seconds=0.0, memory=0))))


def _end_with(parent: int) -> None:
    """End this process once its worker has gone."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
