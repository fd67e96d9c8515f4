"""How far long loops are, a terminal for people, and how a process loads its modules and ends."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import AbstractContextManager, contextmanager
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


def end_at_once() -> None:
    """Declare that a command has closed all its files: the process may exit at once, without freeing its memory."""
    global _ends_at_once
    _ends_at_once = True


def ends_at_once() -> bool:
    """True after `end_at_once`."""
    return _ends_at_once
