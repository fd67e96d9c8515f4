"""One changing line on a terminal: where the work stands, and how long it still takes. Silent where nobody watches."""

from __future__ import annotations

import atexit
import codecs
import json
import os
import sys
import time
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from functools import cache, wraps
from math import isfinite
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TextIO, TypeVar

if TYPE_CHECKING:
    from stitch.frames import Array
    from stitch.measurement.session import Session
    from stitch.runs.recorder import Recorder
    from stitch.runs.run import Run, StageResult


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

    def say(self, text: str | _Elapsed) -> None:
        """Show a text in place of the last."""
        if not sys.stderr.isatty():
            return
        if self._status is None:
            # Loaded by who shows something: most commands end before.
            from stitch.system.process import console

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


# Progress on a terminal, as one of the recorders.


class Progress:
    """The changing line of a terminal; silent elsewhere."""

    def __init__(self) -> None:
        self.unit = "mm"

    def start(self, session: Session) -> None:
        """Name what is being done."""
        self.unit = session.length_unit
        live_line().begin(f"{session.name}: {len(session.views)} views, finding the hand-eye")

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Show where the iteration stands."""
        from stitch.units import length_text

        # Labelled points have their partners by name.
        within = f", partners within {length_text(gate, self.unit)}" if isfinite(gate) else ""
        live_line().begin(f"{stage} {index + 1}: {length_text(rms, self.unit, 4)} rms{within}")

    def stage(self, result: StageResult, poses: Array) -> None:
        """A stage has ended."""

    def finish(self, run: Run) -> None:
        """What follows takes its time too."""
        live_line().begin(f"{run.session.name}: writing cloud and page")


# Progress for programs: one JSON object a line on standard error, where STITCH_PROGRESS=json asks for it.

PROGRESS_VARIABLE = "STITCH_PROGRESS"


def progress_lines_requested() -> bool:
    """True where the program that started this one reads lines."""
    return os.environ.get(PROGRESS_VARIABLE) == "json"


class ProgressLines:
    """A recorder that says where the work stands: {"progress": "fit", "iteration": 3, "rms_um": 32.7}."""

    def __init__(self) -> None:
        self.to_um = 1e3

    def start(self, session: Session) -> None:
        """What is worked on."""
        from stitch.units import MICROMETRES

        self.to_um = MICROMETRES[session.length_unit]
        _print_line(progress="start", session=session.name, views=len(session.views))

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """One more iteration; the first is 1."""
        _print_line(progress=stage, iteration=index + 1, rms_um=rms * self.to_um)

    def stage(self, result: StageResult, poses: Array) -> None:
        """A stage has ended."""
        _print_line(progress=result.name, ended=True, rms_um=result.rms * self.to_um)

    def finish(self, run: Run) -> None:
        """Recording and page are written next."""
        _print_line(
            progress="writing", residual_um=run.residual_rms * self.to_um, heldout_um=run.heldout_rms * self.to_um
        )


def _print_line(**facts: Any) -> None:
    known = {key: value for key, value in facts.items() if value == value}  # JSON has no NaN
    print(json.dumps(known), file=sys.stderr, flush=True)


# Who watches a command work: the terminal, a program that reads lines, and the recording.


def recorder_for(folder: Path, recording: bool) -> Recorder:
    """Progress on a terminal or as lines, and the recording."""
    from stitch.runs.recorder import RecorderGroup
    from stitch.writing.run_folder import recordings

    lines: list[Recorder] = [ProgressLines()] if progress_lines_requested() else []
    return RecorderGroup([Progress(), *lines, *(recordings(folder) if recording else [])])


# Standard output carries results alone; what libraries and a user's effects print goes to standard error.

Command = TypeVar("Command", bound=Callable[..., Any])
_REPLACEMENTS = {
    "µ": "u",
    "μ": "u",
    "–": "-",
    "—": "-",
    "±": "+-",
    "×": "x",
    "·": "*",
    "…": "...",
    "→": "->",
    "°": " deg",
}
_results: list[IO[str]] = []


def stdout_for_results(command: Command) -> Command:
    """The command with standard output kept for `emit`."""

    @wraps(command)
    def apart(*arguments: Any, **options: Any) -> Any:
        with _stdout_redirected():
            return command(*arguments, **options)

    return apart  # type: ignore[return-value]


def results_stream() -> IO[str]:
    """Standard output, for results."""
    return _results[-1] if _results else sys.stdout


def emit(text: str) -> None:
    """Write a result, and a line end, on standard output."""
    print(text, file=results_stream(), flush=True)


@contextmanager
def _stdout_redirected() -> Iterator[None]:
    with _descriptor_redirected(sys.stdout) as stream:
        _results.append(stream)
        try:
            with redirect_stdout(sys.stderr):
                yield
        finally:
            _results.pop()


@contextmanager
def _descriptor_redirected(out: TextIO) -> Iterator[IO[str]]:
    """What compiled libraries write to descriptor 1 goes to 2 as well."""
    try:
        out.flush()
        real = out.fileno() == 1
    except (OSError, ValueError):
        real = False
    if not real:
        yield out
        return
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with os.fdopen(os.dup(kept), "w", encoding=out.encoding, errors=out.errors) as stream:
            yield stream
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def speak_any_terminal() -> None:
    """Spell what a terminal's encoding does not have: um for µm."""
    codecs.register_error("stitch-spell", _replace_unencodable)
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, ValueError):
            if (stream.encoding or "").lower().replace("-", "") != "utf8":
                stream.reconfigure(errors="stitch-spell")  # type: ignore[union-attr]


def _replace_unencodable(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    told = ""
    for letter in error.object[error.start : error.end]:
        plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
        told += _REPLACEMENTS.get(letter) or plain or "?"
    return told, error.end
