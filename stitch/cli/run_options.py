"""What `stitch run` was asked for, as plain data."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ModelOptions:
    """From which model a run starts: that of another run as it is, its arm alone, or effects by name."""

    hand_eye: Path | None = None  # run whose model is used and not corrected
    arm: Path | None = None  # run whose arm is kept
    effects: tuple[str, ...] = ()
    effects_file: Path | None = None
    trust: bool = False


@dataclass(frozen=True)
class RunOptions:
    """The options by their names on the command line."""

    output: Path | None = None
    model: ModelOptions = ModelOptions()
    force: bool = False
    keep: bool = False
    register: str | None = None  # method; None: the usual one
    recording: bool = True
    mesh: bool = False
    tolerance: float | None = None
    memory: float | None = None  # bytes
    as_json: bool = False
    says_next: bool = True  # the last line names the next command; a command that calls this on its way names its own
