"""Calls of foreign code that must end in time.

A watching thread interrupts the main thread once a call is due; what cannot be interrupted, on Windows everything, ends
the process, where that is a command.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from stitch.errors import InputError

# Seconds from the interruption to the end of the process, and between two looks.
_GRACE = 3.0
_STEP = 0.25
_ALARM = getattr(signal, "SIGALRM", None)  # Windows has none
_running: dict[int, _Call] = {}  # by thread
_ends_process = False
_watch: threading.Thread | None = None


@dataclass
class _Call:
    due: float  # time.monotonic()
    message: str
    interrupted: bool = False


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


def may_end_process() -> None:
    """A call that cannot be interrupted ends the process: right for a command, not for a program that uses stitch."""
    global _ends_process
    _ends_process = True


def running_over() -> bool:
    """True while a call runs that has been interrupted and has not ended."""
    return any(call.interrupted for call in _running.values())


def _start_watch() -> None:
    """Start the thread that ends calls which take too long, unless it runs already."""
    global _watch
    if _watch is not None and _watch.is_alive():  # in a process that was forked it is not
        return
    _watch = threading.Thread(target=_check_calls, name="stitch-time-limit", daemon=True)
    if _ALARM is not None and threading.current_thread() is threading.main_thread():
        signal.signal(_ALARM, _interrupt_call)
    _watch.start()


def _interrupt_call(*_: Any) -> None:
    for call in list(_running.values()):
        if call.interrupted:
            raise InputError(call.message)


def _check_calls() -> None:
    """Interrupt calls that are overdue, and end the process where one does not heed it; runs in a thread of its own."""
    main = threading.main_thread().ident
    while True:
        time.sleep(_STEP)
        now = time.monotonic()
        for call in list(_running.values()):
            if not call.interrupted and now > call.due:
                call.interrupted = True
                if main is not None and _ALARM is not None and signal.getsignal(_ALARM) is _interrupt_call:
                    signal.pthread_kill(main, _ALARM)
            elif call.interrupted and now > call.due + _GRACE and _ends_process:
                print(f"stitch: {call.message}", file=sys.stderr, flush=True)
                os._exit(InputError.exit_code)
