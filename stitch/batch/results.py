"""Rows of a batch in the order in which they are finished."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from importlib import import_module
from typing import Any

from stitch.batch.cluster import joined_client, local_client, sessions_at_once
from stitch.batch.job import BatchJob
from stitch.batch.one_session import run_session
from stitch.batch.session_row import SessionRow, failed_row
from stitch.errors import NoResultError

_WORKERS_DIED = NoResultError(
    "workers died over it, also when it ran alone; to fix: give it more memory, or thin its scans, and start the batch "
    "again"
)
_SCHEDULER_GONE = NoResultError("the scheduler has gone; to fix: start the same batch again")


def run_jobs(
    jobs: Sequence[BatchJob], workers: int = 1, scheduler: str = "", say: Callable[[str], object] = str
) -> Generator[SessionRow]:
    """Run the jobs on this process, on so many, or on those of a scheduler; rows as they come.

    Args:
        say: is told what somebody has to know meanwhile; by default nobody is.

    Raises:
        InputError: the packages for more than one process are missing, or the scheduler does not answer.
    """
    if workers == 1 and not scheduler:
        yield from map(run_session, jobs)
        return
    opened: AbstractContextManager[Any] = (
        joined_client(scheduler) if scheduler else local_client(min(workers, len(jobs)))
    )
    with opened as client:
        if not client.scheduler_info()["workers"]:
            say(f"{scheduler} has no workers yet; waiting for one (dask worker {scheduler})")
        at_once = sessions_at_once(client)
        yield from rows_from(client, [replace(job, at_once=at_once) for job in jobs])


def rows_from(
    client: Any, jobs: Sequence[BatchJob], work: Callable[[BatchJob], SessionRow] = run_session
) -> Iterator[SessionRow]:
    """Rows from the workers of a client: all jobs at once; then, one after the other, those whose workers died.

    Who has killed a worker is not certain where several sessions were with it, and what is too large beside another
    may have room alone.
    """
    # One group of tasks: the scheduler keeps them, and hands a worker no second one while it has one.
    keys = [(f"stitch-{job.batch}", job.run.name) for job in jobs]
    futures = client.map(work, jobs, key=keys, pure=False)
    job_of = dict(zip(futures, jobs, strict=True))
    suspected = []
    for done in import_module("distributed").as_completed(futures).batches():
        # Fetched together: one by one a scheduler would be busy with that alone.
        whole = [future for future in done if future.status == "finished"]
        told = dict(zip(whole, client.gather(whole), strict=True))
        for future in done:
            job = job_of.pop(future)
            row = told.get(future) or _row_of_future(future, job)
            # The scheduler need not keep what has been told.
            future.release()
            if row is None:
                suspected.append(job)
            else:
                yield row
    for job in suspected:
        alone = client.submit(work, job, key=(f"stitch-{job.batch}-alone", job.run.name), pure=False)
        yield _row_of_future(alone, job) or failed_row(job.session, job.run, _WORKERS_DIED)


def _row_of_future(future: Any, job: BatchJob) -> SessionRow | None:
    """What a future holds; None where workers died."""
    try:
        row: SessionRow = future.result()
        return row
    except Exception as error:  # of the cluster: the session's own are in its row
        match type(error).__name__:
            case "KilledWorker":
                return None
            case "CancelledError" | "FutureCancelledError":
                return failed_row(job.session, job.run, _SCHEDULER_GONE)
        return failed_row(job.session, job.run, error)
