"""Stitch robot scans: correct the hand-eye from the scans, register, fuse, and say which effect is missing.

import stitch

run = stitch.run(stitch.load_session("blade-17"))
print(stitch.diagnose(run).sentence)
run = stitch.add(run, "joint_compliance")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

# Type checkers do not read the table; `as` exports a name to them. A test compares the two.
if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import Diagnosis as Diagnosis
    from stitch.errors import InputError as InputError
    from stitch.errors import NoResultError as NoResultError
    from stitch.errors import StitchError as StitchError
    from stitch.measurement.session import Session as Session
    from stitch.model.model import Model as Model
    from stitch.model.model_toml import read_model as read_model
    from stitch.pipeline import diagnose as diagnose
    from stitch.pipeline import run as run
    from stitch.pipeline import run_rig as run_rig
    from stitch.reading.session_folder import load_session as load_session
    from stitch.revision import add as add
    from stitch.revision import drop as drop
    from stitch.runs.run import Run as Run

# Public names and their modules. A module is imported on first use: reading a session does not wait for the statistics.
MODULES = {
    "Diagnosis": "stitch.diagnosis.diagnosis",
    "InputError": "stitch.errors",
    "Model": "stitch.model.model",
    "NoResultError": "stitch.errors",
    "Run": "stitch.runs.run",
    "Session": "stitch.measurement.session",
    "StitchError": "stitch.errors",
    "add": "stitch.revision",
    "diagnose": "stitch.pipeline",
    "drop": "stitch.revision",
    "load_session": "stitch.reading.session_folder",
    "read_model": "stitch.model.model_toml",
    "run": "stitch.pipeline",
    "run_rig": "stitch.pipeline",
}

__all__ = list(MODULES)


def __getattr__(name: str) -> Any:
    if name not in MODULES:
        raise AttributeError(f"module 'stitch' has no attribute {name!r}")
    return getattr(import_module(MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *MODULES})
