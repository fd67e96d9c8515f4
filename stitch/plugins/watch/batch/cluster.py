"""Workers for a batch: processes of this machine, or those of a scheduler elsewhere (dask.distributed)."""

import logging
import signal
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any

from stitch.errors import InputError
from stitch.system.packages import command_for
from stitch.system.process import KEPT_ARRAY_BYTES, KEPT_BYTES

_ANSWER_SECONDS = 10.0  # seconds within which a scheduler has to answer
_SETTINGS = {
    # A worker has one session and no other: if it dies, only that one is suspected.
    "distributed.scheduler.worker-saturation": 1.0,
    # A session may be given to a second worker, and no further while others are waiting.
    "distributed.scheduler.allowed-failures": 1,
    # Sessions take seconds: nothing has to look at the workers a hundred times in each.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # As the command line does for its own process; by itself Dask has workers give all memory back at once.
    "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 1,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": KEPT_ARRAY_BYTES,
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": KEPT_BYTES,
}


@contextmanager
def local_client(workers: int) -> Iterator[Any]:
    """Yield a client of so many processes of this machine, one session each at a time; all end with the block.

    They speak by TLS under keys made for this batch: nobody else on the machine can hand them work.

    Raises:
        InputError: the packages for it are not installed.
    """
    distributed, dask = _package(), import_module("dask")
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_SETTINGS))
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="stitch-batch-", ignore_cleanup_errors=True))
        try:
            security = distributed.Security.temporary()
        except ImportError:
            raise _missing_package_error("cryptography") from None
        with _interrupts_ignored():  # by the workers, who inherit it
            cluster = distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=0,
                security=security,
                dashboard_address="127.0.0.1:0",
                local_directory=scratch,
                silence_logs=logging.CRITICAL,
            )
        stack.callback(_close_client, cluster)
        client = distributed.Client(cluster)
        stack.callback(_close_client, client)
        client.register_plugin(_interrupt_shield(distributed), name="stitch-deaf")
        yield client


@contextmanager
def joined_client(address: str) -> Iterator[Any]:
    """Yield a client of a scheduler that runs already.

    Raises:
        InputError: distributed is not installed, or nobody answers there.
    """
    distributed = _package()
    try:
        client = distributed.Client(address, timeout=_ANSWER_SECONDS)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"--scheduler {address}: no answer ({reason}); to fix: start one (`dask scheduler`), or correct the address"
        ) from None
    with ExitStack() as stack:
        stack.callback(_close_client, client)
        yield client


def sessions_at_once(client: Any) -> int:
    """Return how many sessions the workers of the busiest machine may have at a time: they share its cores.

    Args:
        client: of Dask, or a pool of this machine.
    """
    if not hasattr(client, "scheduler_info"):
        return int(getattr(client, "_max_workers", 1))
    at_once: Counter[str] = Counter()
    for worker in client.scheduler_info(n_workers=-1)["workers"].values():
        at_once[worker["host"]] += worker["nthreads"]
    return max(at_once.values(), default=1)


def _interrupt_shield(distributed: Any) -> Any:
    """Return what every worker does first, one that takes the place of a dead one too."""

    class Deaf(distributed.WorkerPlugin):  # type: ignore[misc]
        """Who pressed Ctrl-C wants the batch to end: the workers are ended by it."""

        def setup(self, worker: Any) -> None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    return Deaf()


def _close_client(open_one: Any) -> None:
    """Close; a second Ctrl-C does not leave processes behind."""
    with _interrupts_ignored():
        open_one.close()


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not the main thread: it hears none
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _package() -> Any:
    try:
        package = import_module("distributed")
    except ModuleNotFoundError:
        raise _missing_package_error("distributed") from None
    # What dies is part of the result, and is told there.
    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return package


def _missing_package_error(package: str) -> InputError:
    return InputError(
        f"more than one process needs the package {package}; to fix: {command_for('cluster')}, or leave out "
        "--workers and --scheduler"
    )
