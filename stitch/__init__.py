"""Stitch robot scans: correct the hand-eye from the scans, register, fuse, and say which effect is missing.

import stitch

session = stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", unit="mm")
run = stitch.run(session)
print(run)
print(stitch.diagnose(run).sentence)
run = stitch.add(run, "range_scale")
run.save("runs/blade-17")
"""

from functools import cache
from importlib import import_module
from typing import Any

# Public names of the core and their modules; type checkers read __init__.pyi instead. A module is imported on first
# use: reading a session does not wait for the statistics.
_CORE = {
    "CheckedSession": "stitch.api.check",
    "Diagnosis": "stitch.diagnosis.diagnosis",
    "InputError": "stitch.errors",
    "LiveSession": "stitch.api.live",
    "Model": "stitch.model.model",
    "NoResultError": "stitch.errors",
    "Run": "stitch.api.run",
    "Session": "stitch.api.session",
    "StitchError": "stitch.errors",
    "add": "stitch.api.verbs",
    "check": "stitch.api.check",
    "compare": "stitch.api.verbs",
    "diagnose": "stitch.api.verbs",
    "drop": "stitch.api.verbs",
    "live": "stitch.api.live",
    "load_run": "stitch.api.verbs",
    "load_session": "stitch.api.session",
    "next_view": "stitch.api.verbs",
    "read_model": "stitch.model.model_toml",
    "report": "stitch.api.verbs",
    "run": "stitch.api.verbs",
    "run_rig": "stitch.api.verbs",
}


def __getattr__(name: str) -> Any:
    """Return a public name, whose module is loaded now: `import stitch` alone takes no time."""
    if name in _CORE:
        return getattr(import_module(_CORE[name]), name)
    if name == "MODULES":
        return _modules()
    if name == "__all__":
        return list(_modules())
    if name == "__version__":
        return import_module("stitch.system.packages").stitch_version()
    if not name.startswith("_") and name in _modules():
        return getattr(import_module(_modules()[name]), name)
    raise AttributeError(f"module 'stitch' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return what people call, without the inside."""
    return [*_modules(), "MODULES", "__version__"]


@cache
def _modules() -> dict[str, str]:
    """Public names and their modules: those of the core, and of plug-ins the verbs (entry-point group stitch.verbs)."""
    # Read when it is asked for: it takes a third of the whole import.
    metadata = import_module("importlib.metadata")
    verbs = {verb.name: verb.module for verb in metadata.entry_points(group="stitch.verbs")}
    return dict(sorted((verbs | _CORE).items()))
