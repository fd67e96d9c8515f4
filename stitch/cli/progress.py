"""Progress on a terminal, as one of the recorders."""

import atexit
from collections.abc import Sequence
from math import isfinite

from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.runs.recorder import Recorder
from stitch.runs.run import Run, StageResult
from stitch.system.console import console
from stitch.units import MICROMETRES


class Progress:
    """One changing line on standard error; silent when that is no terminal."""

    def __init__(self) -> None:
        self.console = console()
        self.status = self.console.status("reading") if self.console.is_terminal else None
        self.to_um = 1e3

    def start(self, session: Session) -> None:
        """Name what is being done."""
        self.to_um = MICROMETRES[session.length_unit]
        if self.status:
            # An error on the way must not leave the terminal without a cursor.
            atexit.register(self.status.stop)
            self.status.start()
            self.status.update(f"{session.name}: {len(session.views)} views, finding the hand-eye")

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Show where the iteration stands."""
        if self.status:
            # Labelled points have their partners by name.
            within = f", partners within {gate * self.to_um:.4g} µm" if isfinite(gate) else ""
            self.status.update(f"{stage} {index + 1}: {rms * self.to_um:.4g} µm rms{within}")

    def stage(self, result: StageResult, poses: Array, residuals: list[Array]) -> None:
        """A stage has ended."""

    def finish(self, run: Run) -> None:
        """Clear the line."""
        if self.status:
            self.status.stop()


class Tee:
    """Several recorders at once."""

    def __init__(self, recorders: Sequence[Recorder]) -> None:
        self.recorders = recorders

    def start(self, session: Session) -> None:
        """Pass on."""
        for recorder in self.recorders:
            recorder.start(session)

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Pass on."""
        for recorder in self.recorders:
            recorder.iteration(stage, index, poses, rms, gate)

    def stage(self, result: StageResult, poses: Array, residuals: list[Array]) -> None:
        """Pass on."""
        for recorder in self.recorders:
            recorder.stage(result, poses, residuals)

    def finish(self, run: Run) -> None:
        """Pass on."""
        for recorder in self.recorders:
            recorder.finish(run)
