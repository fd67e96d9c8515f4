"""Where external axes and further scanners truly stand, which every model fits; what goes wrong with axes.

Effects change an `AxisMotion`: readings, placement, how a carriage turns along its way, a twist beside the axis' own
motion. Twists are those of the axis' frame, z along the axis, before it has moved. What turns with a table once is a
place of the part on it and shows nothing; what turns against it shows, in the part's frame twice a turn.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch.effects.contract import effect, per_axis, per_scanner
from stitch.numerics.frames import Array, Mask
from stitch.session.axes import AxisMotion
from stitch.session.measurement import Views

# Sides of an axis' frame across it, x and y: z lies along the axis.
_ACROSS = ("u", "v")
# Components along these two sides in a twist: of its rotation, and of its translation.
_ACROSS_ROTATION, _ACROSS_TRANSLATION = slice(0, 2), slice(3, 5)
PLACEMENT, SCANNER_PLACEMENT = "axis_placement", "scanner_placement"


@effect(
    "axis",
    needs=("axis",),
    tier="geometry",
    tilt=per_axis("rotary", "rad", 0.005, 0.5, _ACROSS),
    shift=per_axis("rotary", "mm", 5.0, 500.0, _ACROSS),
    turn=per_axis("linear", "rad", 0.005, 0.5, _ACROSS),
)
def axis_placement(motion: AxisMotion, views: Views, tilt: Array, shift: Array, turn: Array) -> AxisMotion:
    """axis truly along exp(tilt) and through the point + shift, both across it; a linear one along exp(turn)

    Args:
        motion: its placement (K, 6) holds a twist for each of K axes in the axis' frame, z along it.
        views: whose axes are the R rotary and L linear ones.
        tilt: (2R,) rad, about x and y of each rotary axis in turn.
        shift: (2R,) length_unit, along x and y of each rotary axis in turn.
        turn: (2L,) rad, about x and y of each linear axis in turn; where a linear axis lies makes no difference.
    """
    placement = motion.placement.copy()
    rotary = views.axes.rotary
    placement[rotary, _ACROSS_ROTATION] += tilt.reshape(-1, 2)
    placement[rotary, _ACROSS_TRANSLATION] += shift.reshape(-1, 2)
    placement[~rotary, _ACROSS_ROTATION] += turn.reshape(-1, 2)
    return replace(motion, placement=placement)


@effect(
    "mount",
    needs=("scanners",),
    tier="geometry",
    r=per_scanner("rad", 0.005, 0.5),
    t=per_scanner("mm", 5.0, 500.0),
)
def scanner_placement(views: Views, r: Array, t: Array) -> Array:
    """every scanner but the first truly at its own hand-eye times exp(r, t)

    Args:
        views: taken by K scanners.
        r, t: (3 (K − 1),) rad and length_unit, scanner after scanner from the second on.
    """
    twists = np.column_stack([r.reshape(-1, 3), t.reshape(-1, 3)])
    return np.vstack([np.zeros(6), twists])[views.scanners.of_view]


@effect("axis", needs=("rotary_axis",), A=per_axis("rotary", "mm", 0.05, 2.0), B=per_axis("rotary", "mm", 0.05, 2.0))
def axis_eccentricity(motion: AxisMotion, views: Views, A: Array, B: Array) -> AxisMotion:
    """centre off by A (sin θ, cos θ) + B (cos θ, −sin θ), θ the reading"""
    return replace(motion, error=motion.error + _counter_rotating(motion, views, A, B, (3, 4)))


@effect(
    "axis", needs=("rotary_axis",), A=per_axis("rotary", "rad", 2e-4, 0.01), B=per_axis("rotary", "rad", 2e-4, 0.01)
)
def axis_wobble(motion: AxisMotion, views: Views, A: Array, B: Array) -> AxisMotion:
    """axis tilts by A (sin θ, cos θ) + B (cos θ, −sin θ), θ the reading"""
    return replace(motion, error=motion.error + _counter_rotating(motion, views, A, B, (0, 1)))


def _counter_rotating(motion: AxisMotion, views: Views, A: Array, B: Array, sides: Sequence[int]) -> Array:
    """Return twists (V, K, 6) in the axes' frames that turn once a turn against the part on a rotary axis.

    Component sides[0] is A sin θ + B cos θ, sides[1] is A cos θ − B sin θ, θ the reading; zero for linear axes.

    Args:
        A, B: (R,) amplitudes of the R rotary axes, in the unit of those components.
        sides: indices of two components of a twist across the axis.
    """
    rotary = views.axes.rotary
    angle = motion.readings[:, rotary]
    error = np.zeros_like(motion.error)
    error[:, rotary, sides[0]] = A * np.sin(angle) + B * np.cos(angle)
    error[:, rotary, sides[1]] = A * np.cos(angle) - B * np.sin(angle)
    return error


@effect("axis", needs=("linear_axis",), s=per_axis("linear", "1", 3e-4, 0.01))
def axis_scale(motion: AxisMotion, views: Views, s: Array) -> AxisMotion:
    """way = (1 + s) × reading"""
    return replace(motion, readings=motion.readings * (1 + _spread(s, ~views.axes.rotary)))


@effect("axis", needs=("linear_axis",), p=per_axis("linear", "rad/m", 2e-4, 0.02, ("x", "y", "z")))
def axis_pitch(motion: AxisMotion, views: Views, p: Array) -> AxisMotion:
    """the carriage turns by p × way: pitch and yaw, on an arc, and roll"""
    along = motion.along.copy()
    along[~views.axes.rotary] += p.reshape(-1, 3) / views.axes.per_metre
    return replace(motion, along=along)


@effect("axis", needs=("axis",), b=per_axis("rotary", "rad", 2e-4, 0.01), c=per_axis("linear", "mm", 0.05, 2.0))
def axis_backlash(motion: AxisMotion, views: Views, b: Array, c: Array) -> AxisMotion:
    """reading − b × approach, the direction of the last move; b of a rotary axis, c of a linear one"""
    play = _spread(b, views.axes.rotary) + _spread(c, ~views.axes.rotary)
    return replace(motion, readings=motion.readings - play * views.axes.approach)


def _spread(values: Array, where: Mask) -> Array:
    """Return an array (K,) with `values` where the mask `where` (K,) is True, zero elsewhere."""
    out = np.zeros(len(where))
    out[where] = values
    return out
