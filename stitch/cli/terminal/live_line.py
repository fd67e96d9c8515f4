"""One changing line on a terminal: where the work stands, and how long it still takes. Silent where nobody watches."""

import atexit
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

# What ends sooner (s) needs no line.
_SOON = 1.0


@dataclass(frozen=True)
class _Elapsed:
    """What is done, and for how long: how many iterations there will be nobody knows."""

    text: str
    started: float

    def __rich__(self) -> Any:
        from rich.text import Text

        seconds = round(time.monotonic() - self.started)
        return Text(f"{self.text}; {seconds // 60}:{seconds % 60:02d}")


class LiveLine:
    """A line on standard error that begins with the first text."""

    def __init__(self) -> None:
        self._status: Any = None
        self._visible = False
        self._elapsed: _Elapsed | None = None

    def begin(self, text: str) -> None:
        """Show a text with the time since it was first asked for, until `stop`; loops stand in its place meanwhile."""
        self._elapsed = _Elapsed(text, time.monotonic() if self._elapsed is None else self._elapsed.started)
        self.say(self._elapsed)

    def loops_ended(self) -> None:
        """What stood before the loops stands again; nothing if there was nothing."""
        if self._elapsed is None:
            self.stop()
        else:
            self.say(self._elapsed)

    def say(self, text: "str | _Elapsed") -> None:
        """Show a text in place of the last."""
        if not sys.stderr.isatty():
            return
        if self._status is None:
            # Loaded by who shows something: most commands end before.
            from stitch.system.console import console

            self._status = console().status("")
        if not self._visible:
            # An error on the way must not leave the terminal without a cursor.
            atexit.register(self._status.stop)
            self._status.start()
            self._visible = True
        self._status.update(text)

    def stop(self) -> None:
        """Clear the line; the next text begins it anew."""
        self._elapsed = None
        if self._status is not None and self._visible:
            self._status.stop()
            self._visible = False


@cache
def live_line() -> LiveLine:
    """The one line of this process: two would fight for the cursor."""
    return LiveLine()


@contextmanager
def show_activity(text: str) -> Iterator[None]:
    """While the block lasts, the line says what is done, and for how long, unless something more precise does."""
    live_line().begin(text)
    try:
        yield
    finally:
        live_line().stop()


class TimeLeft:
    """Watches loops, and loops within them: sessions: 2 of 5, 1:07 left; scans: 12 of 40, 0:07 left."""

    def __init__(self) -> None:
        self._started: dict[str, float] = {}  # by label, the outermost first
        self._texts: dict[str, str] = {}

    def __call__(self, label: str, done: int, total: int) -> None:
        """A step begins; after the last one the loop is no longer spoken of."""
        now = time.monotonic()
        if done == 0:
            self._started[label] = now
        if done >= total:
            self._started.pop(label, None)
            self._texts.pop(label, None)
            if not self._texts:
                live_line().loops_ended()
            return
        text = time_left_text(label, done, total, now - self._started.get(label, now))
        if text is not None:
            self._texts[label] = text
            live_line().say("; ".join(self._texts[name] for name in self._started if name in self._texts))


def time_left_text(label: str, done: int, total: int, seconds: float) -> str | None:
    """What to say after so many seconds; None while it is too early to know."""
    if seconds < _SOON or not 0 < done < total:
        return None
    left = round(seconds / done * (total - done))
    return f"{label}: {done} of {total}, {left // 60}:{left % 60:02d} left"
