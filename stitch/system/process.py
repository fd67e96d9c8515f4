"""How far long loops are, a terminal for people, and how a process loads its modules and ends."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import AbstractContextManager, contextmanager, suppress
from importlib.util import LazyLoader, find_spec, module_from_spec
from typing import IO, TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.console import Console

Item = TypeVar("Item")
# What is worked on, how many are done, of how many; of none where nobody knows.
Watcher = Callable[[str, int, int], None]
_watchers: list[Watcher] = []
_answers: list[Callable[[], IO[str]]] = []
# Seconds until a line says what is done, and until the next one.
QUIET = 2.0
AGAIN = 10.0
_ends_at_once = False
# As mallopt(3) numbers them.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
# Arrays from so many bytes on go back to the system when they are freed (glibc allows no more), and so much that is
# free stays at the top of a heap; then both where memory is short.
KEPT_ARRAY_BYTES, KEPT_BYTES = 32 * 2**20, 512 * 2**20
_MAPPED_BYTES, _TOP_BYTES = 2_000_000, 20_000_000


@contextmanager
def watched(watcher: Watcher) -> Iterator[None]:
    """Call `watcher` with (step, done, total) for every step that is announced until the block ends, in any thread."""
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


def steps(label: str, items: Iterable[Item], total: int | None = None) -> Iterator[Item]:
    """Yield the items; before each one, and after the last, tell the watchers how many are done of how many.

    Watchers hear nothing where the number of items is not known.

    Args:
        label: what is worked on, in the plural: "scans".
        total: number of items; None: their own length, if they have one.
    """
    count = len(items) if total is None and isinstance(items, Sized) else total
    if not _watchers or count is None:
        yield from items
        return
    for done, item in enumerate(items):
        announce(label, done, count)
        yield item
    announce(label, count, count)


def announce(step: str, done: int = 0, total: int = 0) -> None:
    """Tell all watchers the step that begins, and how many items are done of how many; a total of 0: no loop."""
    for watcher in _watchers:
        watcher(step, done, total)


@contextmanager
def tell_seconds(step: str) -> Iterator[None]:
    """Print on standard error, after QUIET seconds of the block and every AGAIN seconds, the step and its duration.

    A thread prints while the block runs in the caller's. Nothing is printed where the variable STITCH_PROGRESS is set:
    then another program has asked for progress in its own format.

    Args:
        step: what the block does, for people.
    """
    ended = threading.Event()
    begun = time.monotonic()

    def tell() -> None:
        """Print the step with its minutes and seconds now and again until it ends."""
        wait = QUIET
        while not ended.wait(wait):
            seconds = round(time.monotonic() - begun)
            wait = AGAIN
            print(f"{step}; {seconds // 60}:{seconds % 60:02d}", file=sys.stderr, flush=True)

    if not os.environ.get("STITCH_PROGRESS"):
        threading.Thread(target=tell, daemon=True).start()
    try:
        yield
    finally:
        ended.set()


@contextmanager
def held_last(stack: list[Item], item: Item) -> Iterator[None]:
    """Keep an item at the end of a list while the block lasts."""
    stack.append(item)
    try:
        yield
    finally:
        stack.pop()


def answers_to(stream: Callable[[], IO[str]]) -> AbstractContextManager[None]:
    """Send what people read to the stream that `stream()` returns while the block lasts, not to standard error.

    For commands whose text is their result, and so belongs on standard output.
    """
    return held_last(_answers, stream)


def answer_stream() -> IO[str] | None:
    """Return where what people read goes; None is standard error."""
    # Asked anew for each line: a command may keep descriptor 1 for its results and let it lead to 2 meanwhile.
    return _answers[-1]() if _answers else None


def console(file: IO[str] | None = None) -> Console:
    """Return a rich console on a stream, None: standard error. Names and paths print as they are, without markup."""
    from stitch.system.lines import PeopleConsole

    return PeopleConsole(file=file, stderr=file is None, markup=False, emoji=False, highlight=False)


def load_on_use(*names: str) -> None:
    """Register modules, by dotted name, so that importing them is free and their first attribute loads them.

    Modules that are loaded already, or not installed, are passed over.
    """
    for name in names:
        spec = find_spec(name)
        if name in sys.modules or spec is None or spec.loader is None:
            continue
        spec.loader = LazyLoader(spec.loader)
        module = sys.modules[name] = module_from_spec(spec)
        spec.loader.exec_module(module)
        package, _, last = name.rpartition(".")
        setattr(sys.modules[package], last, module)


def keep_freed_memory() -> None:
    """Make glibc serve all threads from one heap that keeps what they free; elsewhere do nothing.

    For processes of stitch's own, before they have threads. By itself glibc gives each thread a heap and the system
    what is free at its top. Arrays of a few megabytes are made and freed thousands of times in a run: their pages are
    cleared each time, which takes a tenth of it.
    """
    _set_allocator({_M_ARENA_MAX: 1, _M_MMAP_THRESHOLD: KEPT_ARRAY_BYTES, _M_TRIM_THRESHOLD: KEPT_BYTES})


def return_large_arrays() -> None:
    """Make glibc return arrays of 2 MB and more to the system as soon as they are freed; elsewhere do nothing.

    By itself glibc raises that limit to 32 MB. Freed arrays of thousands of poses then stay in the heap of every
    thread: a third more memory than is in use. The price is a new mapping for each array, too much for small sessions.
    """
    _set_allocator({_M_MMAP_THRESHOLD: _MAPPED_BYTES, _M_TRIM_THRESHOLD: _TOP_BYTES})


def _set_allocator(options: dict[int, int]) -> None:
    """Set options of mallopt(3) in this process where glibc is its library."""
    import ctypes

    # Other libraries have no such function, and Windows no library without a name.
    with suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for option, value in options.items():
            mallopt(option, value)


def end_at_once() -> None:
    """Declare that a command has closed all its files: the process may exit at once, without freeing its memory."""
    global _ends_at_once
    _ends_at_once = True


def ends_at_once() -> bool:
    """True after `end_at_once`."""
    return _ends_at_once
