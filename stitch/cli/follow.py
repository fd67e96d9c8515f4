"""`stitch run SESSION --follow`: judge each view of a session folder as its scan and its row arrive."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from stitch.cli.terminal import say
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.api.live import LiveSession

# Seconds between two looks, and how long a file may be half-written before that is said.
_EVERY, _PATIENCE = 0.3, 5.0


def follow_session(folder: Path, views: int | None) -> None:
    """Take in views as they come, until so many are there or Ctrl-C is pressed.

    Args:
        views: how many to wait for; None: until Ctrl-C.

    Raises:
        InputError: session.toml is missing or wrong, or the poses are of another convention than it states.
    """
    from stitch.api.live import follow
    from stitch.reading.session_folder import load_session, read_session_document

    table = folder / "views.csv"
    read_session_document(folder / "session.toml")
    end = "Ctrl-C ends it and runs the session" if views is None else f"the session is run once {views} views are there"
    say(f"Following {folder}: each view is judged as its scan and its row in views.csv arrive; {end}.")
    live: LiveSession | None = None
    failed = _Failures()
    try:
        while views is None or live is None or len(live.said) < views:
            try:
                session = load_session(folder, scans=False) if table.is_file() else None
            except InputError as error:
                failed.note(str(error))
                session = None
            if session is not None:
                live = live or follow(session)
                for name in session.names:
                    if name in live.session.names:
                        continue
                    try:
                        view = load_session(folder, only=name).views[0]
                    except InputError as error:
                        failed.note(str(error))
                        break
                    say(str(live.take(view)))
                    failed = _Failures()
            time.sleep(_EVERY)
    except KeyboardInterrupt:
        if live is None:
            raise
    proposed = None if live is None else live.next_pose()
    if proposed is not None and views is None:
        say(str(proposed))


class _Failures:
    """What cannot be read yet: said once, after some patience, since a file may be half-written."""

    def __init__(self) -> None:
        self._since: float | None = None
        self._said = ""

    def note(self, message: str) -> None:
        """Remember that reading failed, and print why if it has failed for long."""
        now = time.monotonic()
        self._since = self._since or now
        if now - self._since > _PATIENCE and message != self._said:
            say(f"waiting: {message}")
            self._said = message
