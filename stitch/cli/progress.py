"""Where the work stands: one changing line on a terminal, a plain line a step elsewhere, JSON where asked for."""

from __future__ import annotations

import atexit
import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stitch.system.process import AGAIN, QUIET

if TYPE_CHECKING:
    from stitch.numerics.frames import Array
    from stitch.run_data import RunData, StageResult
    from stitch.session.session import SessionData

_SOON = 1.0  # a loop that ends sooner (s) needs no time left
PROGRESS_VARIABLE = "STITCH_PROGRESS"  # json: lines for programs; off: none on what is no terminal


@contextmanager
def show_activity(text: str) -> Iterator[None]:
    """Show a text and the time since it began while the block lasts, until a loop inside shows something else."""
    live_line().begin(text)
    try:
        yield
    finally:
        live_line().stop()


@contextmanager
def opened_run(run: Path, effects_file: Path | None, trust: bool, activity: str) -> Iterator[RunData]:
    """Yield the run of a folder; no other process may write into the folder while the block lasts.

    Args:
        effects_file: Python file of effects, in place of the one that the model names.
        trust: run the file that the model names.
        activity: text that is shown while it is read.
    """
    from stitch.output import run_folder, stored_run

    with run_folder.lock_run_folder(run):
        with show_activity(activity):
            state = stored_run.load_run(run, effects_file, trust=trust)
        yield state


@cache
def live_line() -> LiveLine:
    """Return the one line of this process: two would fight for the cursor."""
    return LiveLine()


class LiveLine:
    """A changing line on standard error: the present step and the time since the command began.

    On anything but a terminal, plain lines take its place. No share is shown, since nobody knows the number of
    iterations beforehand. Rich draws the object itself again and again, in a thread of its own, so that the time runs.
    """

    def __init__(self) -> None:
        """Begin with an empty line: nothing is shown before the first text."""
        self._status: Any = None
        self._visible = False
        self._step = self._detail = ""
        self._began = time.monotonic()  # the clock of all steps of a command: it never runs backwards
        self._runs = False
        self._plain = _PlainLines()

    def __str__(self) -> str:
        seconds = round(time.monotonic() - self._began)
        return f"{self._step}{self._detail}; {seconds // 60}:{seconds % 60:02d}"

    def __rich__(self) -> Any:
        from rich.text import Text

        return Text(str(self))

    def begin(self, step: str, detail: str = "") -> None:
        """Show a step with the running time until `stop`; a loop shown by `say` stands in its place meanwhile."""
        self._step, self._detail = step, detail
        self._runs = True
        self.say(self, step)

    def loops_ended(self) -> None:
        """Show again the step that stood before a loop began; clear the line if there was none."""
        if self._runs:
            self.say(self, self._step)
        else:
            self.stop()

    def say(self, text: object, step: str) -> None:
        """Show a text in place of the last one.

        Args:
            text: a string, or an object that is drawn as text anew each time.
            step: name of the step to which the text belongs: without a terminal each step is printed on its own line.
        """
        if not sys.stderr.isatty():
            if not os.environ.get(PROGRESS_VARIABLE):
                self._plain.show(step, text)
            return
        if self._status is None:
            # Imported here: most commands end before they show something.
            from stitch.system.process import console

            self._status = console().status("")
        if not self._visible:
            # An error on the way must not leave the terminal without a cursor.
            atexit.register(self._status.stop)
            self._status.start()
            self._visible = True
        self._status.update(text)

    def stop(self) -> None:
        """Clear the line; the next text shows it again."""
        self._runs = False
        self._plain.stop()
        if self._status is not None and self._visible:
            self._status.stop()
            self._visible = False


class _PlainLines:
    """Prints a line for each step where there is no terminal; none in the first `QUIET` seconds of the work.

    A timer's thread prints the first line, the thread that works all others.
    """

    def __init__(self) -> None:
        self._timer: threading.Timer | None = None
        self._step, self._text = "", object()
        self._printed: dict[str, float] = {}  # when each step was printed

    def show(self, step: str, text: object) -> None:
        """Print a step when it begins, and again if the last line is `AGAIN` seconds old.

        The first call starts the timer; until it prints, nothing is printed: the work may soon be over.
        """
        self._step, self._text = step, text
        if self._timer is None:
            self._timer = threading.Timer(QUIET, self._print)
            self._timer.daemon = True
            self._timer.start()
        elif self._printed and (step not in self._printed or time.monotonic() - max(self._printed.values()) > AGAIN):
            self._print()

    def _print(self) -> None:
        self._printed[self._step] = time.monotonic()
        print(self._text, file=sys.stderr, flush=True)

    def stop(self) -> None:
        """Print nothing more; the next step begins anew."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._printed = None, {}


class TimeLeft:
    """Shows the time left of loops and of loops within them, as in "sessions: 2 of 5, 1:07 left; scans: …".

    It is called by the loops themselves (`stitch.system.threads`).
    """

    def __init__(self) -> None:
        self._started: dict[str, float] = {}  # by label, the outermost first
        self._texts: dict[str, str] = {}

    def __call__(self, label: str, done: int, total: int) -> None:
        """Show how far a loop is.

        Args:
            label: name of the loop.
            done: number of steps that are done; 0 begins the loop, `total` ends it.
            total: number of steps; 0: no loop, the label alone is shown.
        """
        if total == 0:
            live_line().begin(label)
            return
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
            live_line().say("; ".join(self._texts[name] for name in self._started if name in self._texts), label)


def time_left_text(label: str, done: int, total: int, seconds: float) -> str | None:
    """Return the text of a loop with its time left, extrapolated from the steps done; None in its first second.

    Args:
        seconds: since the loop began.
    """
    if seconds < _SOON or not 0 < done < total:
        return None
    left = round(seconds / done * (total - done))
    return f"{label}: {done} of {total}, {left // 60}:{left % 60:02d} left"


class Progress:
    """A recorder that shows the stage and iteration of a run in the changing line.

    With STITCH_PROGRESS=json it prints JSON for programs too: {"progress": "fit", "iteration": 3, "rms_um": 32.7}.
    """

    def __init__(self) -> None:
        self._unit = "mm"
        self._to_um = 1e3
        self._prints_lines = os.environ.get(PROGRESS_VARIABLE) == "json"

    def start(self, session: SessionData) -> None:
        """Show that a session's hand-eye is being searched, and take over its length unit."""
        from stitch.numerics.units import MICROMETRES

        self._unit = session.length_unit
        self._to_um = MICROMETRES[session.length_unit]
        live_line().begin(f"{session.name}: {len(session.views)} views, finding the hand-eye")
        self._print(progress="start", session=session.name, views=len(session.views))

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Show an iteration, counted from 1 for people, with its rms and its gate (both length_unit; NaN: no gate)."""
        from stitch.numerics.units import length_text

        # Labelled points have their partners by name.
        within = f", partners within {length_text(gate, self._unit)}" if isfinite(gate) else ""
        live_line().begin(stage, f", iteration {index + 1}: {length_text(rms, self._unit, 4)} rms{within}")
        self._print(progress=stage, iteration=index + 1, rms_um=rms * self._to_um)

    def stage(self, result: StageResult, poses: Array) -> None:
        """Print that a stage has ended, for programs."""
        self._print(progress=result.name, ended=True, rms_um=result.rms * self._to_um)

    def finish(self, run: RunData) -> None:
        """Show that cloud and page are being written: that takes seconds after the run itself."""
        live_line().begin(f"{run.session.name}: writing cloud and page")
        residual, heldout = run.residual_rms * self._to_um, run.heldout_rms * self._to_um
        self._print(progress="writing", residual_um=residual, heldout_um=heldout)

    def _print(self, **facts: Any) -> None:
        if self._prints_lines:
            known = {key: value for key, value in facts.items() if value == value}  # JSON has no NaN
            print(json.dumps(known), file=sys.stderr, flush=True)
