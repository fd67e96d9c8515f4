"""What the stages show while they work; a viewer implements `Recorder`, the stages do not know it."""

from collections.abc import Sequence
from concurrent.futures import CancelledError
from typing import Any, Protocol

from stitch.model.model import Model
from stitch.numerics.frames import Array
from stitch.run_data import RunData, StageResult
from stitch.session.session import SessionData


class Recorder(Protocol):
    """Receives every stage and iteration. All poses are T_reference_scanner, (V, 4, 4)."""

    def start(self, session: SessionData) -> None:
        """Called once, before the first stage, with the scans and the robot's path."""

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Called after each iteration of a stage; `gate` is the largest distance paired."""

    def stage(self, result: StageResult, poses: Array) -> None:
        """Called at the end of a stage."""

    def finish(self, run: RunData) -> None:
        """Called once, with the result."""


class SilentRecorder:
    """A recorder that shows nothing."""

    def start(self, session: SessionData) -> None: ...
    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None: ...
    def stage(self, result: StageResult, poses: Array) -> None: ...
    def finish(self, run: RunData) -> None: ...


class IterationMemory(SilentRecorder):
    """Keeps the iterations of a stage that runs beside others, to tell them in their turn."""

    def __init__(self) -> None:
        self._kept: list[tuple[str, int, Array, float, float]] = []
        self.stopped = False

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Keep one iteration.

        Raises:
            CancelledError: nobody wants the stage any more (`stopped`).
        """
        if self.stopped:
            raise CancelledError
        self._kept.append((stage, index, poses, rms, gate))

    def tell(self, recorder: Recorder) -> None:
        """Pass on all that was kept."""
        for kept in self._kept:
            recorder.iteration(*kept)


class RunMemory:
    """Keeps what is told of runs that are tried one after the other, to tell it of the one that counts."""

    def __init__(self) -> None:
        self._kept: list[tuple[str, tuple[Any, ...]]] = []
        self._finished: list[tuple[Model, list[tuple[str, tuple[Any, ...]]]]] = []

    def start(self, session: SessionData) -> None:
        """Begin to keep a run."""
        self._kept = [("start", (session,))]

    def iteration(self, *told: Any) -> None:
        """Keep one iteration."""
        self._kept.append(("iteration", told))

    def stage(self, *told: Any) -> None:
        """Keep the end of a stage."""
        self._kept.append(("stage", told))

    def finish(self, run: RunData) -> None:
        """Keep what was told as that of a run."""
        self._finished.append((run.model, self._kept))

    def tell(self, recorder: Recorder, run: RunData) -> None:
        """Pass on all that was told of a run, and the run as it is now."""
        kept = next((kept for model, kept in self._finished if model is run.model), [])
        for what, told in kept:
            getattr(recorder, what)(*told)
        recorder.finish(run)


class RecorderGroup:
    """Several recorders at once."""

    def __init__(self, recorders: Sequence[Recorder]) -> None:
        self.recorders = recorders

    def start(self, session: SessionData) -> None:
        """Pass on."""
        for recorder in self.recorders:
            recorder.start(session)

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Pass on."""
        for recorder in self.recorders:
            recorder.iteration(stage, index, poses, rms, gate)

    def stage(self, result: StageResult, poses: Array) -> None:
        """Pass on."""
        for recorder in self.recorders:
            recorder.stage(result, poses)

    def finish(self, run: RunData) -> None:
        """Pass on."""
        for recorder in self.recorders:
            recorder.finish(run)
