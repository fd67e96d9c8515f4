"""Physical effects along the chain of frames, each a short function: what nature does.

Importing the package registers the library; `user_file.load` adds a user's own.
"""

from stitch.effects import arm, empirical, mount, part, sensor
from stitch.effects.contract import EFFECTS, Effect, Parameter, effect
from stitch.effects.specs import event, number, offset, per_joint, per_torque, twist

__all__ = [
    "EFFECTS",
    "Effect",
    "Parameter",
    "arm",
    "effect",
    "empirical",
    "event",
    "mount",
    "number",
    "offset",
    "part",
    "per_joint",
    "per_torque",
    "sensor",
    "twist",
]
