"""Stitch robot scans: correct the hand-eye from the scans, register, fuse, and say which effect is missing.

import stitch

session = stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", unit="mm")
run = stitch.run(session)
print(run)
print(stitch.diagnose(run).sentence)
run = stitch.add(run, "range_scale")
run.save("runs/blade-17")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

# Type checkers do not read the table; `as` exports a name to them. A test compares the two.
if TYPE_CHECKING:
    from stitch.api.live import LiveSession as LiveSession
    from stitch.api.live import live as live
    from stitch.api.run import Run as Run
    from stitch.api.session import Session as Session
    from stitch.api.session import load_session as load_session
    from stitch.api.verbs import add as add
    from stitch.api.verbs import compare as compare
    from stitch.api.verbs import diagnose as diagnose
    from stitch.api.verbs import drop as drop
    from stitch.api.verbs import explain as explain
    from stitch.api.verbs import export_run as export_run
    from stitch.api.verbs import load_run as load_run
    from stitch.api.verbs import plan as plan
    from stitch.api.verbs import run as run
    from stitch.api.verbs import run_rig as run_rig
    from stitch.diagnosis.diagnosis import Diagnosis as Diagnosis
    from stitch.errors import InputError as InputError
    from stitch.errors import NoResultError as NoResultError
    from stitch.errors import StitchError as StitchError
    from stitch.model.model import Model as Model
    from stitch.model.model_toml import read_model as read_model

# Public names and their modules. A module is imported on first use: reading a session does not wait for the statistics.
MODULES = {
    "Diagnosis": "stitch.diagnosis.diagnosis",
    "InputError": "stitch.errors",
    "LiveSession": "stitch.api.live",
    "Model": "stitch.model.model",
    "NoResultError": "stitch.errors",
    "Run": "stitch.api.run",
    "Session": "stitch.api.session",
    "StitchError": "stitch.errors",
    "add": "stitch.api.verbs",
    "compare": "stitch.api.verbs",
    "diagnose": "stitch.api.verbs",
    "drop": "stitch.api.verbs",
    "explain": "stitch.api.verbs",
    "export_run": "stitch.api.verbs",
    "live": "stitch.api.live",
    "load_run": "stitch.api.verbs",
    "load_session": "stitch.api.session",
    "plan": "stitch.api.verbs",
    "read_model": "stitch.model.model_toml",
    "run": "stitch.api.verbs",
    "run_rig": "stitch.api.verbs",
}

__all__ = list(MODULES)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        # Read when it is asked for: it takes a third of the whole import.
        return import_module("importlib.metadata").version("stitch")
    if name not in MODULES:
        raise AttributeError(f"module 'stitch' has no attribute {name!r}")
    return getattr(import_module(MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *MODULES, "__version__"})
