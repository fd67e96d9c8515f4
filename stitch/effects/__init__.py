"""Physical effects along the chain of frames, each a short function: what nature does.

Importing the package registers the library, and what installed packages offer (`stitch.effects`); `user_file.load` adds
a user's own.
"""

from stitch.effects import axis_effects, empirical, library
from stitch.effects.contract import (
    EFFECTS,
    Effect,
    Parameter,
    effect,
    event,
    number,
    offset,
    per_joint,
    per_moment,
    per_torque,
    temperature,
    twist,
    vector,
)
from stitch.effects.user_file import load_packages

load_packages()

__all__ = [
    "EFFECTS",
    "Effect",
    "Parameter",
    "axis_effects",
    "effect",
    "empirical",
    "event",
    "library",
    "number",
    "offset",
    "per_joint",
    "per_moment",
    "per_torque",
    "temperature",
    "twist",
    "vector",
]
