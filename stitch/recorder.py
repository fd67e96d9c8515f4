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
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.stopped = False

    def tell(self, call: str, *arguments: Any) -> None:
        """Keep one call.

        Raises:
            CancelledError: nobody wants the stages any more (`stopped`), so that they end here.
        """
        if self.stopped:
            raise CancelledError
        self.calls.append((call, arguments))

    def start(self, session: SessionData) -> None:
        """Tell that a run begins."""
        self.tell("start", session)

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Tell one iteration."""
        self.tell("iteration", stage, index, poses, rms, gate)

    def stage(self, result: StageResult, poses: Array) -> None:
        """Tell the end of a stage."""
        self.tell("stage", result, poses)

    def finish(self, run: RunData) -> None:
        """Tell the result."""
        self.tell("finish", run)

    def replay(self, recorder: Recorder) -> None:
        """Pass on all that was kept."""
        for call, arguments in self.calls:
            getattr(recorder, call)(*arguments)


class RunMemory(RecorderMemory):
    """Keeps what is told of runs that are tried one after the other, to tell it of the one that counts."""

    def __init__(self) -> None:
        super().__init__()
        self._finished: list[tuple[Model, list[tuple[str, tuple[Any, ...]]]]] = []

    def start(self, session: SessionData) -> None:
        """Begin to keep another run."""
        self.calls = []
        super().start(session)

    def finish(self, run: RunData) -> None:
        """Take what was kept as that of a run."""
        self._finished.append((run.model, self.calls))

    def replay_run(self, recorder: Recorder, run: RunData) -> None:
        """Pass on all that was kept of a run, and the run as it is now."""
        self.calls = next((calls for model, calls in self._finished if model is run.model), [])
        self.replay(recorder)
        recorder.finish(run)


class RecorderGroup(RecorderMemory):
    """Several recorders at once."""

    def __init__(self, recorders: Sequence[Recorder]) -> None:
        super().__init__()
        self.recorders = recorders

    def tell(self, call: str, *arguments: Any) -> None:
        """Pass on one call, which nobody asks for again."""
        for recorder in self.recorders:
            getattr(recorder, call)(*arguments)
