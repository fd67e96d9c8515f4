"""Loops that take long say how far they are; whoever watches decides what is shown. Without a watcher nothing is."""

from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
# What is worked on, how many are done, of how many.
Watcher = Callable[[str, int, int], None]
_watchers: list[Watcher] = []


@contextmanager
def watched(watcher: Watcher) -> Iterator[None]:
    """Tell `watcher` of every step until the block ends."""
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


def steps(label: str, items: Iterable[Item], total: int | None = None) -> Iterator[Item]:
    """The items, one after the other, each announced as it is asked for.

    Args:
        label: what is worked on, in the plural: "scans".
        total: how many there are, where the items do not say.
    """
    count = len(items) if total is None and isinstance(items, Sized) else total
    if not _watchers or count is None:
        yield from items
        return
    for done, item in enumerate(items):
        _notify_watchers(label, done, count)
        yield item
    _notify_watchers(label, count, count)


def _notify_watchers(label: str, done: int, total: int) -> None:
    for watcher in _watchers:
        watcher(label, done, total)
