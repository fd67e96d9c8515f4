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
from shutil import copyfile
from typing import TYPE_CHECKING, Any

from stitch.system.process import AGAIN, QUIET

if TYPE_CHECKING:
    from stitch.numerics.frames import Array
    from stitch.recorder import Recorder
    from stitch.run_data import RunData, StageResult
    from stitch.session.session import SessionData

_SOON = 1.0  # a loop that ends sooner (s) needs no time left
PROGRESS_VARIABLE = "STITCH_PROGRESS"  # json: lines for programs; off: none on what is no terminal


@contextmanager
def show_activity(text: str) -> Iterator[None]:
    """Say what the block does, and for how long, wherever nothing more precise is said."""
    live_line().begin(text)
    try:
        yield
    finally:
        live_line().stop()


@contextmanager
def opened_run(run: Path, effects_file: Path | None, trust: bool, activity: str) -> Iterator[RunData]:
    """Hold a run folder as its only writer while the block lasts, and give the run that wrote it.

    Args:
        activity: what is said while it is read.
    """
    from stitch.output import run_folder, stored_run

    with run_folder.lock_run_folder(run):
        with show_activity(activity):
            state = stored_run.load_run(run, effects_file, trust=trust)
        yield state


def recorder_for(folder: Path, recording: bool, earlier: Path | None = None) -> Recorder:
    """Return progress on a terminal or as lines, and the recording, which goes on where that of an earlier folder
    ends."""
    from stitch.output.run_folder import recordings
    from stitch.recorder import RecorderGroup

    shown = recordings(folder) if recording else []
    if shown and earlier is not None and (earlier / "recording.rrd").is_file():
        copyfile(earlier / "recording.rrd", folder / "recording.rrd")
    return RecorderGroup([Progress(), *shown])


@cache
def live_line() -> LiveLine:
    """Return the one line of this process: two would fight for the cursor."""
    return LiveLine()


class LiveLine:
    """A line on standard error that begins with the first text; as text its step, and for how long the work has lasted.

    How many iterations there will be nobody knows.
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
        """Show a step with the time since the first of all, until `stop`; loops stand in its place meanwhile."""
        self._step, self._detail = step, detail
        self._runs = True
        self.say(self, step)

    def loops_ended(self) -> None:
        """Show the step that stood before the loops; nothing if there was none."""
        if self._runs:
            self.say(self, self._step)
        else:
            self.stop()

    def say(self, text: object, step: str) -> None:
        """Show a text of a step in place of the last."""
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
        """Clear the line; the next text begins it anew."""
        self._runs = False
        self._plain.stop()
        if self._status is not None and self._visible:
            self._status.stop()
            self._visible = False


class _PlainLines:
    """A line for each step on what is no terminal, once the work has lasted a while."""

    def __init__(self) -> None:
        self._timer: threading.Timer | None = None
        self._step, self._text = "", object()
        self._printed: dict[str, float] = {}  # when each step was printed

    def show(self, step: str, text: object) -> None:
        """Print a step as it begins, and again after a while; nothing while the work may soon be over."""
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
    """Watches loops, and loops within them: sessions: 2 of 5, 1:07 left; scans: 12 of 40, 0:07 left."""

    def __init__(self) -> None:
        self._started: dict[str, float] = {}  # by label, the outermost first
        self._texts: dict[str, str] = {}

    def __call__(self, label: str, done: int, total: int) -> None:
        """Show that a step of a loop begins, or work that is no loop; clear the loop after its last step."""
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
    """Return what to say after so many seconds; None while it is too early to know."""
    if seconds < _SOON or not 0 < done < total:
        return None
    left = round(seconds / done * (total - done))
    return f"{label}: {done} of {total}, {left // 60}:{left % 60:02d} left"


class Progress:
    """A recorder that moves the changing line, and prints lines for the program that asks for them.

    Such a line says where the work stands: {"progress": "fit", "iteration": 3, "rms_um": 32.7}.
    """

    def __init__(self) -> None:
        self._unit = "mm"
        self._to_um = 1e3
        self._prints_lines = os.environ.get(PROGRESS_VARIABLE) == "json"

    def start(self, session: SessionData) -> None:
        """Name what is being done."""
        from stitch.numerics.units import MICROMETRES

        self._unit = session.length_unit
        self._to_um = MICROMETRES[session.length_unit]
        live_line().begin(f"{session.name}: {len(session.views)} views, finding the hand-eye")
        self._print(progress="start", session=session.name, views=len(session.views))

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Show where the iteration stands; the first is 1."""
        from stitch.numerics.units import length_text

        # Labelled points have their partners by name.
        within = f", partners within {length_text(gate, self._unit)}" if isfinite(gate) else ""
        live_line().begin(stage, f", iteration {index + 1}: {length_text(rms, self._unit, 4)} rms{within}")
        self._print(progress=stage, iteration=index + 1, rms_um=rms * self._to_um)

    def stage(self, result: StageResult, poses: Array) -> None:
        """A stage has ended."""
        self._print(progress=result.name, ended=True, rms_um=result.rms * self._to_um)

    def finish(self, run: RunData) -> None:
        """What follows takes its time too: recording and page are written next."""
        live_line().begin(f"{run.session.name}: writing cloud and page")
        residual, heldout = run.residual_rms * self._to_um, run.heldout_rms * self._to_um
        self._print(progress="writing", residual_um=residual, heldout_um=heldout)

    def _print(self, **facts: Any) -> None:
        if self._prints_lines:
            known = {key: value for key, value in facts.items() if value == value}  # JSON has no NaN
            print(json.dumps(known), file=sys.stderr, flush=True)
