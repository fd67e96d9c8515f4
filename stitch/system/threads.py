"""One level of threads: ours, over views and view pairs.

Queries of one pair are too small to share out, and two libraries that both spin for the same cores
slow each other down twentyfold; so libraries run single-threaded inside a run.
"""

import mmap
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, wraps
from itertools import chain
from threading import RLock, Thread
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from stitch.errors import InputError
from stitch.system.process import steps

Item = TypeVar("Item")
Result = TypeVar("Result")
# A mapped array is looked at in so many parts.
_PARTS = 64
# Of a long loop: enough of them to keep all cores busy to its end.
_PORTIONS = 100
_processes = 1


def parallel(function: Callable[[Item], Result], items: Iterable[Item], label: str = "") -> Iterator[Result]:
    """Return an iterator over `function(item)` of all items, in their order, computed by one pool of threads.

    `function` must not call `parallel` itself: it would wait for a thread of the pool that it occupies.

    Args:
        label: what the items are, "scans"; watchers of progress then hear of each. Empty: they hear nothing.
    """
    pool = _pool()
    every = list(items)
    if label:
        return steps(label, pool.map(function, every), len(every))
    # Handing thousands of small items to threads one by one would take as long as the work: they go in portions.
    size = max(len(every) // _PORTIONS, 1)
    portions = (every[start : start + size] for start in range(0, len(every), size))
    return chain.from_iterable(pool.map(lambda portion: [function(item) for item in portion], portions))


@cache
def _pool() -> ThreadPoolExecutor:
    """Return the pool of this process: a thread per core that is left to it, libraries single-threaded in each."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return ThreadPoolExecutor(
        max_workers=max(cores // _processes, 1), thread_name_prefix="stitch", initializer=library_threads_off
    )


def _forget_threads() -> None:
    """Drop the pool and OpenMP's threads in a forked process: only the parent has them, and waiting would not end."""
    _pool.cache_clear()
    threadpool_limits(1, user_api="openmp")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_threads)


def share_cores(processes: int) -> None:
    """Size the pool for so many processes like this one that share the cores; call it before the first `parallel`."""
    global _processes
    _processes = processes


def begin(function: Callable[[], Result]) -> Future[Result]:
    """Start a function in a new thread and return the future of its result; the function may call `parallel`.

    The thread is a daemon: a process that ends does not wait for it, so that the function must not write files.
    """
    future = Future[Result]()

    def run() -> None:
        """Run the function, and hand its result or its error to the future."""
        library_threads_off()
        try:
            future.set_result(function())
        except BaseException as error:
            future.set_exception(error)

    Thread(target=run, name="stitch-beside", daemon=True).start()
    return future


def library_threads_off() -> Any:
    """Limit OpenMP and BLAS to one thread; also a context manager. OpenMP counts per calling thread."""
    return threadpool_limits(1)


def map_parts(parts: Iterable[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return tables of the same columns joined row after row, each column mapped from a temporary file of its own.

    Only one part is in memory at a time. The files have no name, so that they vanish with the process.

    Args:
        parts: tables as name -> array; under one name all have the same dtype and the same shape but for the rows.

    Returns:
        Name -> memory map (rows of all parts, ...).

    Raises:
        InputError: no room in the folder for temporary files.
    """
    files: dict[str, Any] = {}
    layout: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
    rows = 0
    for part in parts:
        for name, values in part.items():
            if name not in files:
                files[name] = tempfile.TemporaryFile()  # noqa: SIM115  # the map holds it
            layout[name] = values.dtype, values.shape[1:]
            try:
                np.ascontiguousarray(values).tofile(files[name])
            except OSError:
                raise InputError(
                    f"{tempfile.gettempdir()}: no room for what does not fit in memory; to fix: make room, or name "
                    "another folder in the environment variable TMPDIR"
                ) from None
        rows += len(next(iter(part.values())))
    return {name: np.memmap(files[name], kind, "r", shape=(rows, *rest)) for name, (kind, rest) in layout.items()}


def take_mapped(array: NDArray[Any], rows: NDArray[np.int64]) -> NDArray[Any]:
    """Return a copy of the rows of an array at the indices `rows` (K,).

    A memory map is read in `_PARTS` pieces, and what was read of it leaves the memory after each.
    """
    if not isinstance(array, np.memmap):
        return array[rows]
    taken = np.empty((len(rows), *array.shape[1:]), array.dtype)
    for part in np.array_split(np.arange(len(rows)), _PARTS):
        taken[part] = array[rows[part]]
        release_mapped(array)
    return taken


def release_mapped(array: NDArray[Any]) -> None:
    """Free the memory that pages of a memory map take; they are read again when asked for. Other arrays stay."""
    held = getattr(array, "_mmap", None)
    if isinstance(array, np.memmap) and held is not None and hasattr(mmap, "MADV_DONTNEED"):
        held.madvise(mmap.MADV_DONTNEED)


class Clock:
    """A stopwatch: seconds since the last call of `lap`, at first since it was made."""

    def __init__(self) -> None:
        self.last = time.perf_counter()

    def lap(self) -> float:
        """Return the seconds since the last call, or since the clock was made."""
        before = self.last
        self.last = time.perf_counter()
        return self.last - before


def remembered(function: Callable[[Item], Result]) -> Callable[[Item], Result]:
    """Decorate a function of one object: its result is stored in that object's `__dict__`, and computed once for each.

    Like `cached_property`, for functions of packages that the object's own package may not import. A lock per function
    makes a second thread wait for the result of the first.
    """
    key = f"{function.__module__}.{function.__qualname__}"
    lock = RLock()

    @wraps(function)
    def stored_result(subject: Item) -> Result:
        """Return the stored result of `function(subject)`, computed first where there is none."""
        with lock:
            values = vars(subject)
            if key not in values:
                values[key] = function(subject)
            return values[key]

    return stored_result
