"""Effects of the scanner's mount: the true one is M·exp(twist)."""

import numpy as np

from stitch.effects.contract import effect
from stitch.effects.specs import number, twist
from stitch.frames import Array
from stitch.measurement.views import Views


@effect("mount", needs=("time",), xi=twist("/h", 1e-3, 0.4))
def mount_drift(views: Views, xi: Array) -> Array:
    """M·exp(ξ (t−t₀)/3600 s)"""
    return np.outer(views.hours, xi)


@effect(
    "mount",
    needs=("time",),
    xi=twist("", 6e-4, 0.2),
    T_c=number("s", typical=600.0, limit=1e5, grid=(150.0, 300.0, 600.0, 1200.0)),
)
def mount_warmup(views: Views, xi: Array, T_c: float) -> Array:
    """M·exp(ξ (1−e^(−(t−t₀)/T_c)))"""
    return np.outer(1 - np.exp(-views.time / max(T_c, 1.0)), xi)
