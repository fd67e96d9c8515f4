"""What the stages show while they work; a viewer implements `Recorder`, the stages do not know it."""

from collections.abc import Sequence
from concurrent.futures import CancelledError
from typing import Any, Protocol

from stitch.model.model import Model
from stitch.numerics.frames import Array
from stitch.run_data import RunData, StageResult
from stitch.session.session import SessionData


class Recorder(Protocol):
    """Receives every stage and iteration, and does nothing. All poses are T_reference_scanner, (V, 4, 4)."""

    def start(self, session: SessionData) -> None:
        """Called once, before the first stage, with the scans and the robot's path."""
        return

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Called after each iteration of a stage; `gate` is the largest distance paired."""
        return

    def stage(self, result: StageResult, poses: Array) -> None:
        """Called at the end of a stage."""
        return

    def finish(self, run: RunData) -> None:
        """Called once, with the result."""
        return


class SilentRecorder(Recorder):
    """A recorder that shows nothing."""


class RecorderMemory:
    """Keeps what it is told by stages that run beside others, to tell it in their turn."""

    def __init__(self) -> None:
        self._calls: list[tuple[str, tuple[Any, ...]]] = []
        self.stopped = False

    def start(self, session: SessionData) -> None:
        """Keep that a run begins."""
        self._keep("start", session)

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Keep one iteration."""
        self._keep("iteration", stage, index, poses, rms, gate)

    def stage(self, result: StageResult, poses: Array) -> None:
        """Keep the end of a stage."""
        self._keep("stage", result, poses)

    def finish(self, run: RunData) -> None:
        """Keep the result."""
        self._keep("finish", run)

    def _keep(self, method: str, *arguments: Any) -> None:
        """Keep one call.

        Raises:
            CancelledError: nobody wants the stages any more (`stopped`), so that they end here.
        """
        if self.stopped:
            raise CancelledError
        self._calls.append((method, arguments))

    def replay(self, recorder: Recorder) -> None:
        """Pass on all that was kept."""
        for method, arguments in self._calls:
            getattr(recorder, method)(*arguments)


class RunMemory(RecorderMemory):
    """Keeps what is told of runs that are tried one after the other, to tell it of the one that counts."""

    def __init__(self) -> None:
        super().__init__()
        self._finished: list[tuple[Model, list[tuple[str, tuple[Any, ...]]]]] = []

    def start(self, session: SessionData) -> None:
        """Begin to keep another run."""
        self._calls = []
        super().start(session)

    def finish(self, run: RunData) -> None:
        """Take what was kept as that of a run."""
        self._finished.append((run.model, self._calls))

    def tell(self, recorder: Recorder, run: RunData) -> None:
        """Pass on all that was kept of a run, and the run as it is now."""
        self._calls = next((calls for model, calls in self._finished if model is run.model), [])
        self.replay(recorder)
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
