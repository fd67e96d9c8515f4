"""What the stages show while they work; a viewer implements `Recorder`, the stages do not know it."""

from collections.abc import Sequence
from concurrent.futures import CancelledError
from typing import Any, Protocol

from stitch.model.model import Model
from stitch.numerics.frames import Array
from stitch.run_data import RunData, StageResult
from stitch.session.session import SessionData


class Recorder(Protocol):
    """What a viewer implements to follow a run; by default each call does nothing.

    All poses are T_reference_scanner (V, 4, 4), lengths in length_unit.
    """

    def start(self, session: SessionData) -> None:
        """Called once, before the first stage, with the scans and the robot's path."""
        return

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Called after each iteration of a stage.

        Args:
            stage: coarse | correct | register | fuse, or fit: the model's parameters on given correspondences.
            index: of the iteration.
            poses: (V, 4, 4) T_reference_scanner after it.
            rms: of the distances between corresponding points, length_unit.
            gate: largest distance between two corresponding points, length_unit; NaN of labelled points.
        """
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
    """A recorder that stores its calls, so that they can be replayed later to another one.

    Stages that run in the background record into one each; the main thread replays them in the order of the stages.
    """

    def __init__(self) -> None:
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.stopped = False

    def tell(self, call: str, *arguments: Any) -> None:
        """Store one call: the method's name and its arguments.

        Raises:
            CancelledError: another thread has set `stopped`, since the result is not needed: the stage ends here.
        """
        if self.stopped:
            raise CancelledError
        self.calls.append((call, arguments))

    def start(self, session: SessionData) -> None:
        """Store the call `start`."""
        self.tell("start", session)

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Store the call `iteration`."""
        self.tell("iteration", stage, index, poses, rms, gate)

    def stage(self, result: StageResult, poses: Array) -> None:
        """Store the call `stage`."""
        self.tell("stage", result, poses)

    def finish(self, run: RunData) -> None:
        """Store the call `finish`."""
        self.tell("finish", run)

    def replay(self, recorder: Recorder) -> None:
        """Make all stored calls on another recorder, in their order."""
        for call, arguments in self.calls:
            getattr(recorder, call)(*arguments)

    def hand_over(self, recorder: Recorder) -> None:
        """Make all stored calls on another recorder and forget them; another thread may store more meanwhile."""
        while self.calls:
            call, arguments = self.calls.pop(0)
            getattr(recorder, call)(*arguments)


class RunMemory(RecorderMemory):
    """A recorder that stores the calls of several runs that are tried in turn, to replay those of the chosen one."""

    def __init__(self) -> None:
        super().__init__()
        self._finished: list[tuple[Model, list[tuple[str, tuple[Any, ...]]]]] = []

    def start(self, session: SessionData) -> None:
        """Begin to store the calls of another run."""
        self.calls = []
        super().start(session)

    def finish(self, run: RunData) -> None:
        """File the calls stored since `start` under the model of their run."""
        self._finished.append((run.model, self.calls))

    def replay_run(self, recorder: Recorder, run: RunData) -> None:
        """Make all calls of the run with the same model object on another recorder, then `finish` with `run`."""
        self.calls = next((calls for model, calls in self._finished if model is run.model), [])
        self.replay(recorder)
        recorder.finish(run)


class RecorderGroup(RecorderMemory):
    """A recorder that passes every call on to several recorders at once, and stores none."""

    def __init__(self, recorders: Sequence[Recorder]) -> None:
        super().__init__()
        self.recorders = recorders

    def tell(self, call: str, *arguments: Any) -> None:
        """Make one call on every recorder."""
        for recorder in self.recorders:
            getattr(recorder, call)(*arguments)
