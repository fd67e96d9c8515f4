"""How far long loops are, a terminal for people, and calls of foreign code that must end in time."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import LazyLoader, find_spec, module_from_spec
from typing import IO, TYPE_CHECKING, Any, TypeVar

from stitch.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console


Item = TypeVar("Item")
# What is worked on, how many are done, of how many; of none where nobody knows.
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
    """Yield the items, each announced to whoever watches as it is asked for.

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


def announce(step: str) -> None:
    """Tell watchers what is worked on next, where no loop says how far it is."""
    _notify_watchers(step, 0, 0)


QUIET, AGAIN = 2.0, 10.0  # seconds until a line says what is done, and until the next one


@contextmanager
def tell_seconds(step: str) -> Iterator[None]:
    """Say on standard error what the block does and for how long, once it has lasted a while; nothing where another
    program asked for its own lines (STITCH_PROGRESS)."""
    ended, begun = threading.Event(), time.monotonic()

    def tell() -> None:
        wait = QUIET
        while not ended.wait(wait):
            seconds, wait = round(time.monotonic() - begun), AGAIN
            print(f"{step}; {seconds // 60}:{seconds % 60:02d}", file=sys.stderr, flush=True)

    if not os.environ.get("STITCH_PROGRESS"):
        threading.Thread(target=tell, daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def _notify_watchers(label: str, done: int, total: int) -> None:
    for watcher in _watchers:
        watcher(label, done, total)


def console(file: IO[str] | None = None) -> Console:
    """Return standard error, or another stream, that prints names and paths as they are: no markup, no emoji codes."""
    from stitch.system.lines import PeopleConsole

    return PeopleConsole(file=file, stderr=file is None, markup=False, emoji=False, highlight=False)


_GRACE = 3.0  # seconds from the interruption to the end of the process
_STEP = 0.25
_running: dict[int, _Call] = {}  # by thread
_ends_process = False
_ends_at_once = False
_watch: threading.Thread | None = None


@dataclass
class _Call:
    due: float  # time.monotonic()
    message: str
    interrupted: bool = False


def may_end_process() -> None:
    """A call that cannot be interrupted ends the process: right for a command, not for a program that uses stitch."""
    global _ends_process
    _ends_process = True


def load_on_use(*names: str) -> None:
    """Let modules of packages be loaded when something of them is asked for, whoever imports them before."""
    for name in names:
        spec = find_spec(name)
        if name in sys.modules or spec is None or spec.loader is None:
            continue
        spec.loader = LazyLoader(spec.loader)
        module = sys.modules[name] = module_from_spec(spec)
        spec.loader.exec_module(module)
        package, _, own = name.rpartition(".")
        setattr(sys.modules[package], own, module)


def end_at_once() -> None:
    """A command that has written and closed all its files: the process may end without giving its memory back."""
    global _ends_at_once
    _ends_at_once = True


def ends_at_once() -> bool:
    """True after a command has said so."""
    return _ends_at_once


def running_over() -> bool:
    """True while a call runs that has been interrupted and has not ended."""
    return any(call.interrupted for call in _running.values())


@contextmanager
def time_limit(seconds: float, message: str) -> Iterator[None]:
    """Raise InputError with `message` in the main thread if the block takes longer."""
    _start_watch()
    thread = threading.get_ident()
    outer = _running.get(thread)
    _running[thread] = _Call(time.monotonic() + seconds, message)
    try:
        yield
    finally:
        if outer is None:
            del _running[thread]
        else:
            _running[thread] = outer


def _start_watch() -> None:
    global _watch
    if _watch is not None or not hasattr(signal, "SIGALRM"):
        return
    _watch = threading.Thread(target=_check_calls, name="stitch-time-limit", daemon=True)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGALRM, _interrupt_call)
    _watch.start()


def _interrupt_call(*_: Any) -> None:
    for call in list(_running.values()):
        if call.interrupted:
            raise InputError(call.message)


def _check_calls() -> None:
    main = threading.main_thread().ident
    while True:
        time.sleep(_STEP)
        now = time.monotonic()
        for call in list(_running.values()):
            if not call.interrupted and now > call.due:
                call.interrupted = True
                if main is not None and signal.getsignal(signal.SIGALRM) is _interrupt_call:
                    signal.pthread_kill(main, signal.SIGALRM)
            elif call.interrupted and now > call.due + _GRACE and _ends_process:
                print(f"stitch: {call.message}", file=sys.stderr, flush=True)
                os._exit(InputError.exit_code)
