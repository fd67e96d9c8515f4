"""One changing line on a terminal: where the work stands, and how long it still takes. Silent where nobody watches."""

import atexit
import sys
import time
from functools import cache
from typing import Any

# What ends sooner (s) needs no line.
_SOON = 1.0


class LiveLine:
    """A line on standard error that begins with the first text."""

    def __init__(self) -> None:
        self._status: Any = None
        self._shown = False

    def say(self, text: str) -> None:
        """Show a text in place of the last."""
        if not sys.stderr.isatty():
            return
        if self._status is None:
            # Loaded by who shows something: most commands end before.
            from stitch.system.console import console

            self._status = console().status("")
        if not self._shown:
            # An error on the way must not leave the terminal without a cursor.
            atexit.register(self._status.stop)
            self._status.start()
            self._shown = True
        self._status.update(text)

    def stop(self) -> None:
        """Clear the line; the next text begins it anew."""
        if self._status is not None and self._shown:
            self._status.stop()
            self._shown = False


@cache
def live_line() -> LiveLine:
    """The one line of this process: two would fight for the cursor."""
    return LiveLine()


class TimeLeft:
    """Watches loops, and loops within them: sessions: 2 of 5, 1:07 left; scans: 12 of 40, 0:07 left."""

    def __init__(self) -> None:
        self._begun: dict[str, float] = {}  # by label, the outermost first
        self._said: dict[str, str] = {}

    def __call__(self, label: str, done: int, total: int) -> None:
        """A step begins; after the last one the loop is no longer spoken of."""
        now = time.monotonic()
        if done == 0:
            self._begun[label] = now
        if done >= total:
            self._begun.pop(label, None)
            self._said.pop(label, None)
            if not self._said:
                live_line().stop()
            return
        text = told(label, done, total, now - self._begun.get(label, now))
        if text is not None:
            self._said[label] = text
            live_line().say("; ".join(self._said[name] for name in self._begun if name in self._said))


def told(label: str, done: int, total: int, seconds: float) -> str | None:
    """What to say after so many seconds; None while it is too early to know."""
    if seconds < _SOON or not 0 < done < total:
        return None
    left = round(seconds / done * (total - done))
    return f"{label}: {done} of {total}, {left // 60}:{left % 60:02d} left"
