"""Several recorders as one."""

from collections.abc import Sequence

from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.runs.recorder import Recorder
from stitch.runs.run import Run, StageResult


class RecorderGroup:
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

    def stage(self, result: StageResult, poses: Array) -> None:
        """Pass on."""
        for recorder in self.recorders:
            recorder.stage(result, poses)

    def finish(self, run: Run) -> None:
        """Pass on."""
        for recorder in self.recorders:
            recorder.finish(run)
