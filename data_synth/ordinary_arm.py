"""An arm like any other: every joint and every link a little wrong, each by its own amount, all at once.

At size 1 every number is normal with the size that a hidden law of one joint has (`nature.py`): offsets of 0.3 mrad,
first harmonics of 0.3 mrad, lengths of 0.25 mm, twists of 0.3 mrad. What an arm does beside that is here too: pose
errors that one view hands on to the next.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data_synth import kinematics
from data_synth.arms import Arm

Array = NDArray[np.float64]
_OFFSET, _WAVE, _LENGTH, _TWIST = 3e-4, 3e-4 / np.sqrt(2), 0.25, 3e-4


@dataclass(frozen=True)
class OrdinaryArm:
    """Errors of every joint (n,) in rad and of the DH rows in mm and rad."""

    offset: Array
    sine: Array
    cosine: Array
    a: Array
    d: Array
    alpha: Array

    def flange(self, arm: Arm, joints: Array) -> Array:
        """(V, 4, 4) where the flange truly is at reported joint angles (V, n)."""
        true = joints + self.offset + self.sine * np.sin(joints) + self.cosine * np.cos(joints)
        wrong = replace(arm, a=arm.a + self.a, d=arm.d + self.d, alpha=arm.alpha + self.alpha)
        return kinematics.flange(wrong, true)


def draw_arm(joints: int, size: float, rng: np.random.Generator) -> OrdinaryArm:
    """One arm of so many joints."""
    return OrdinaryArm(
        *(size * unit * rng.standard_normal(joints) for unit in (_OFFSET, _WAVE, _WAVE, _LENGTH, _LENGTH, _TWIST))
    )


def with_memory(views: int, correlation: float, rng: np.random.Generator) -> Array:
    """(V, 6) of unit variance; every view keeps so much of the one before (AR(1))."""
    fresh = rng.standard_normal((views, 6))
    out = fresh.copy()
    for v in range(1, views):
        out[v] = correlation * out[v - 1] + np.sqrt(1 - correlation**2) * fresh[v]
    return out
