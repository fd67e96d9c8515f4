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
    """Raise InputError with `message` in the main thread if the block takes longer than so many seconds.

    A watching thread sends the signal. Blocks may be nested: only the innermost one of each thread is watched.
    """
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
    """Allow the watching thread to end the process where a call does not heed its interruption.

    Right for a command, not for a program that uses this library.
    """
    global _ends_process
    _ends_process = True


def running_over() -> bool:
    """True while a call runs that has been interrupted and has not ended."""
    return any(call.interrupted for call in _running.values())


def _start_watch() -> None:
    """Start the thread that watches calls, unless it runs already; `time_limit` calls it from the caller's thread.

    Two threads that call at once start two watchers, which does no harm. Only the main thread may install the handler
    of the alarm: without it calls are not interrupted.
    """
    global _watch
    if _watch is not None and _watch.is_alive():  # in a process that was forked it is not
        return
    _watch = threading.Thread(target=_check_calls, name="stitch-time-limit", daemon=True)
    if _ALARM is not None and threading.current_thread() is threading.main_thread():
        signal.signal(_ALARM, _interrupt_call)
    _watch.start()


def _interrupt_call(*_: Any) -> None:
    """Raise InputError for an interrupted call: handler of the alarm, which Python runs in the main thread."""
    for call in list(_running.values()):
        if call.interrupted:
            raise InputError(call.message)


def _check_calls() -> None:
    """Interrupt overdue calls for ever, in the watching thread: by an alarm that raises InputError in the main thread.

    A call that still runs `_GRACE` seconds after its limit ends the process, if `may_end_process` was called.
    """
    main = threading.main_thread().ident
    while True:
        time.sleep(_STEP)
        now = time.monotonic()
        for call in list(_running.values()):
            if not call.interrupted and now > call.due:
                call.interrupted = True
                # The program may have installed a handler of its own since: an alarm is not sent to that one.
                if main is not None and _ALARM is not None and signal.getsignal(_ALARM) is _interrupt_call:
                    signal.pthread_kill(main, _ALARM)
            elif call.interrupted and now > call.due + _GRACE and _ends_process:
                print(f"stitch: {call.message}", file=sys.stderr, flush=True)
                os._exit(InputError.exit_code)
