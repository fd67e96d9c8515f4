"""One level of threads: ours, over views and view pairs.

Queries of one pair are too small to share out, and two libraries that both spin for the same cores
slow each other down twentyfold; so libraries run single-threaded inside a run.
"""

import os
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import chain
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from stitch.system.steps import steps

Item = TypeVar("Item")
Result = TypeVar("Result")


_processes = 1
# Of a long loop: enough of them to keep all cores busy to its end.
_PORTIONS = 100


def share_cores(processes: int) -> None:
    """Leave the cores to so many processes like this one, before the first `parallel`."""
    global _processes
    _processes = processes


@cache
def _pool() -> ThreadPoolExecutor:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return ThreadPoolExecutor(
        max_workers=max(cores // _processes, 1), thread_name_prefix="stitch", initializer=library_threads_off
    )


def parallel(function: Callable[[Item], Result], items: Iterable[Item], label: str = "") -> Iterator[Result]:
    """`map` over the cores, results in order; `function` must not call `parallel` itself.

    Args:
        label: what the items are, for whoever watches a long loop.
    """
    pool, every = _pool(), list(items)
    if label:
        return steps(label, pool.map(function, every), len(every))
    # Thousands of small items would spend as long in being handed out.
    size = max(len(every) // _PORTIONS, 1)
    portions = (every[start : start + size] for start in range(0, len(every), size))
    return chain.from_iterable(pool.map(lambda portion: [function(item) for item in portion], portions))


def library_threads_off() -> Any:
    """Limit OpenMP and BLAS to one thread; also a context manager. OpenMP counts per calling thread."""
    return threadpool_limits(1)


class Clock:
    """Seconds between calls."""

    def __init__(self) -> None:
        self.last = time.perf_counter()

    def lap(self) -> float:
        """Seconds since the last call."""
        now = time.perf_counter()
        self.last, before = now, self.last
        return now - before
