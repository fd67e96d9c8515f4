"""Stitch robot scans: correct the hand-eye from the scans, register, fuse, and say which effect is missing.

import stitch

run = stitch.run(stitch.load_session("blade-17"))
print(stitch.diagnose(run).sentence)
run = stitch.add(run, "joint_compliance")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import Diagnosis
    from stitch.errors import InputError, NoResultError, StitchError
    from stitch.measurement.session import Session
    from stitch.model.model import Model
    from stitch.model.model_toml import read_model
    from stitch.pipeline import diagnose, run, run_rig
    from stitch.reading.session_folder import load_session
    from stitch.revision import add, drop
    from stitch.runs.run import Run

# Where each name lives. It is imported when it is asked for: whoever reads a session does not wait for the statistics.
_HOMES = {
    "Diagnosis": "diagnosis.diagnosis",
    "InputError": "errors",
    "Model": "model.model",
    "NoResultError": "errors",
    "Run": "runs.run",
    "Session": "measurement.session",
    "StitchError": "errors",
    "add": "pipeline",
    "diagnose": "pipeline",
    "drop": "pipeline",
    "load_session": "reading.session_folder",
    "read_model": "model.model_toml",
    "run": "pipeline",
    "run_rig": "pipeline",
}

__all__ = [
    "Diagnosis",
    "InputError",
    "Model",
    "NoResultError",
    "Run",
    "Session",
    "StitchError",
    "add",
    "diagnose",
    "drop",
    "load_session",
    "read_model",
    "run",
    "run_rig",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'stitch' has no attribute {name!r}")
    return getattr(import_module(f"stitch.{_HOMES[name]}"), name)
