"""What `stitch run` was asked for, as plain data."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RunOptions:
    """The options by their names on the command line."""

    output: Path | None = None
    hand_eye: Path | None = None
    arm: Path | None = None
    effects: tuple[str, ...] = ()
    effects_file: Path | None = None
    trust: bool = False
    force: bool = False
    keep: bool = False
    recording: bool = True
    mesh: bool = False
    tolerance: float | None = None
    memory: float | None = None  # bytes
    as_json: bool = False
    says_next: bool = True  # the last line names the next command; a command that calls this on its way names its own
