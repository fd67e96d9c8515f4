"""Shapes of quantities: bumps, teeth, what stays behind, swings and warming up, whose nonlinear parameters a formula
may move; and powers beside their line."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from stitch.explanation.quantity import Family, Nonlinear, Quantity
from stitch.frames import Array
from stitch.measurement.views import Views

# By about what share the true width, play or time constant may differ from one that is tried; how far a bump's middle
# may lie off, in its widths; by how many swings in the session there may be more or fewer, and rad of their phase.
_WIDTH_SPREAD, _PLAY_SPREAD, _CONSTANT_SPREAD = 0.4, 0.2, 0.7
_MIDDLE_SPREAD, _PERIOD_SPREAD, _PHASE_SPREAD = 0.5, 0.25, 0.8
# By what share of itself a tooth, and by what share of a tooth its jump, may lie off.
_TOOTH, _JUMP = 0.05, 0.1
# Share of what a power changes, below which rounding may be all that is beside its line; torques that any power may
# have on a line, or nearly.
_MIN_CURVATURE, _AS_A_LINE = 1e-6, 3


def bump_of_joint(views: Views, k: int, middle: float, width: float) -> Quantity:
    """exp(−((q − middle) / width)² / 2) of joint k, from 0; rad."""
    q, at = views.joints[:, k], f"views.joints[:, {k}]"
    text = f"bump of q{k + 1} at {np.degrees(middle):.0f}°, {np.degrees(width):.2g}° wide"
    return _bump(text, q, at, middle, width, kind="gear", joint=k, family=partial(bump_of_joint, views, k))


def saw_of_joint(views: Views, k: int, tooth: float, jump: float) -> Quantity:
    """From −1/2 to 1/2 along each tooth of so many rad, back at once where joint k passes `jump`; rad.

    Of its jumps the one next to the middle of the joint's range is told: there tooth and jump hardly depend on each
    other.
    """
    q, at = views.joints[:, k], f"views.joints[:, {k}]"
    jump += tooth * round((0.5 * float(q.min() + q.max()) - jump) / tooth)
    return Quantity(
        f"saw of q{k + 1}, a tooth {np.degrees(tooth):.3g}° and a jump at {np.degrees(jump):.3g}°",
        f"(({at} - {jump:.6g}) / {tooth:.6g} % 1 - 0.5)",
        "",
        "teeth",
        k,
        (q - jump) / tooth % 1 - 0.5,
        nonlinear=(Nonlinear(tooth, _TOOTH, positive=True), Nonlinear(jump, _JUMP * tooth)),
        family=partial(saw_of_joint, views, k),
    )


def nonlinear_torque(torque: Quantity, power: Callable[[Array], Array], text: str, code: str) -> Quantity | None:
    """What a power of a torque does that no line does, in these views: the line is the part of the zero and of a
    spring that does not stiffen, and far from zero nearly all of the power. None where the views show nothing of it.

    Args:
        power: of the torque as a share of the largest.
        text: of it, and `code`: of `x`.
    """
    largest = float(f"{np.abs(torque.values).max():.3g}")
    share = torque.values / largest
    slope, zero = np.polyfit(share, power(share), 1)
    values = np.asarray(power(share) - slope * share - zero, float)
    if np.abs(values).max() < _MIN_CURVATURE * np.ptp(power(share)) or len(np.unique(share)) <= _AS_A_LINE:
        return None
    x = f"({torque.code} / {largest:g})"
    return replace(
        torque,
        text=f"({text.replace('x', f'({torque.text}/{largest:g} {torque.unit})')} beside its line)",
        code=f"({code.replace('x', x)} - {slope:.15g} * {x} - {zero:.15g})",
        unit="",
        values=values,
    )


def bump_in_time(views: Views, middle: float, width: float) -> Quantity:
    """exp(−((t − middle) / width)² / 2); h."""
    text = f"bump of t at {middle:.2g} h, {width:.2g} h wide"
    family = partial(bump_in_time, views)
    return _bump(text, views.hours, "views.hours", middle, width, kind="course", joint=None, family=family)


def backlash_lag(views: Views, k: int, play: float) -> Quantity:
    """What stays behind joint k, from 0, within a play of so many rad."""
    return Quantity(
        f"stays ({np.degrees(play):.2g}° of play) behind q{k + 1}",
        f"views.behind({k}, {play:.6g})",
        "",
        "move",
        k,
        views.behind(k, play),
        nonlinear=(Nonlinear(play, _PLAY_SPREAD, positive=True),),
        family=partial(backlash_lag, views, k),
    )


def oscillation(views: Views, period: float, late: float) -> Quantity:
    """cos(2π t/period − late); h, rad."""
    whole = float(views.hours[-1]) or 1.0
    return Quantity(
        f"cos(2π t/{period:.2g} h − {np.degrees(late):.3g}°)",
        f"np.cos(2 * np.pi * views.hours / {period:.6g} - {late:.6g})",
        "",
        "course",
        None,
        np.cos(2 * np.pi * views.hours / period - late),
        nonlinear=(Nonlinear(period, _PERIOD_SPREAD * period / whole, positive=True), Nonlinear(late, _PHASE_SPREAD)),
        family=partial(oscillation, views),
    )


def warm_up(views: Views, constant: float) -> Quantity:
    """1 − exp(−t/constant); h."""
    return Quantity(
        f"(1 − exp(−t/{constant:.2g} h))",
        f"(1 - np.exp(-views.hours / {constant:.6g}))",
        "",
        "time",
        None,
        1 - np.exp(-views.hours / constant),
        nonlinear=(Nonlinear(constant, _CONSTANT_SPREAD, positive=True),),
        family=partial(warm_up, views),
    )


def _bump(
    text: str, x: Array, at: str, middle: float, width: float, *, kind: str, joint: int | None, family: Family
) -> Quantity:
    code = f"np.exp(-0.5 * (({at} - {middle:.6g}) / {width:.6g}) ** 2)"
    # A bump of whose flank alone is seen could be of any height.
    there = float(x.min()), float(x.max())
    free = Nonlinear(middle, _MIDDLE_SPREAD * width, within=there), Nonlinear(width, _WIDTH_SPREAD, positive=True)
    values = np.exp(-0.5 * ((x - middle) / width) ** 2)
    return Quantity(text, code, "", kind, joint, values, nonlinear=free, family=family)
