"""One session of a batch and where its run goes."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class BatchJob:
    """What a worker needs to know; all paths absolute, for it may stand elsewhere."""

    session: Path
    run: Path
    batch: str  # name of this batch, unlike that of any other
    force: bool = False  # run it although it is finished, and replace the run of another session
    recording: bool = True
    at_once: int = 1  # sessions that share the cores of the machine
