"""Stitch robot scans: correct the hand-eye from the scans, register, fuse, and say which effect is missing.

import stitch

run = stitch.run(stitch.load_session("blade-17"))
print(stitch.diagnose(run).sentence)
run = stitch.add(run, "joint_compliance")
"""

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.errors import InputError, NoResultError, StitchError
from stitch.measurement.session import Session
from stitch.model.model import Model
from stitch.model.model_toml import read_model
from stitch.pipeline import add, diagnose, drop, run, run_rig
from stitch.reading.session_folder import load_session
from stitch.runs.run import Run

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
