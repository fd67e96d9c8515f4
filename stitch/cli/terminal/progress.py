"""Progress on a terminal, as one of the recorders."""

from math import isfinite

from stitch.cli.terminal.live_line import live_line
from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.runs.run import Run, StageResult
from stitch.units import length_text


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
        # Labelled points have their partners by name.
        within = f", partners within {length_text(gate, self.unit)}" if isfinite(gate) else ""
        live_line().begin(f"{stage} {index + 1}: {length_text(rms, self.unit, 4)} rms{within}")

    def stage(self, result: StageResult, poses: Array) -> None:
        """A stage has ended."""

    def finish(self, run: Run) -> None:
        """What follows takes its time too."""
        live_line().begin(f"{run.session.name}: writing cloud and page")
