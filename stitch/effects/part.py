"""Effects of the part: it creeps, slips, grows or sags in the reference frame."""

import numpy as np

from stitch.effects.arm import warmer
from stitch.effects.contract import effect
from stitch.effects.specs import event, number, offset, twist
from stitch.frames import Array
from stitch.measurement.views import ScanView, Views


@effect("part", needs=("time",), xi=twist("/h", 1e-3, 0.4))
def fixture_drift(views: Views, xi: Array) -> Array:
    """exp(ξ (t−t₀)/3600 s) in the reference frame"""
    return np.outer(views.hours, xi)


@effect("part", xi=twist("", 6e-4, 0.2), v=event())
def part_slip(views: Views, xi: Array, v: float) -> Array:
    """from view v on (counted from 0), the part sits displaced by ξ"""
    return np.outer(views.number >= v, xi)


@effect(
    "shape",
    prefers=("part_temperature_c",),
    g=number("1/°C", typical=3e-5, limit=5e-4),
    c=offset("mm/°C", typical=3e-3, limit=0.2),
)
def part_growth(points: Array, view: ScanView, g: float, c: Array) -> Array:
    """x = x* + ((x*−o)·g + c)·ΔT, o the flange or the middle of the scans; ΔT of part_temperature_c, else hours

    Scaled about its frame's origin, where no session says: the point at −c/g from o stands still.
    """
    return points + ((points - view.origin) * g + c) * float(warmer(view.views, "part_temperature_c")[view.index])


@effect("shape", kappa=number("1/mm", typical=5e-6, limit=1e-3))
def part_sag(points: Array, view: ScanView, kappa: float) -> Array:
    """point at distance h from the clamp plane (part z=0) moves κ·h² along gravity"""
    return points + kappa * points[:, 2:] ** 2 * view.gravity
