"""Progress for programs: one JSON object a line on standard error, where STITCH_PROGRESS=json asks for it."""

import json
import os
import sys
from typing import Any

from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.runs.run import Run, StageResult
from stitch.units import MICROMETRES

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
