"""Figures of errors by no known law: along what a joint follows, and when in the session."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.unnamed_joint_laws import JointCurve
from stitch.diagnosis.unnamed_time_laws import ROTATION_PART, TRANSLATION_PART, TimeCurve
from stitch.frames import Array
from stitch.observations.pose_errors import time_in_steps
from stitch.units import MICROMETRES
from viz.colours import BLUE, GREEN, ORANGE
from viz.drawing import above, covariate, plain

_AXES = tuple(zip("xyz", (ORANGE, GREEN, BLUE), strict=True))
_HOURS_FROM = 7200.0  # s that are better told in hours than in minutes


def joint_courses(found: Diagnosis, at_most: int = 3) -> Figure:
    """How far joints are off by no known law along what they follow, with two sigmas."""
    shown = found.curves[:at_most]
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    axes = figure.subplots(1, max(len(shown), 1), sharey=True, squeeze=False)[0]
    for ax, c in zip(axes, shown, strict=False):
        error, sigma = 1e3 * c.error, 1e3 * c.sigma
        label, at, stood = _along(c)
        ax.fill_between(at, error - 2 * sigma, error + 2 * sigma, color=BLUE, alpha=0.25, lw=0)
        ax.plot(at, error, color=BLUE)
        ax.plot(stood, np.zeros(len(stood)), "|", color="k", ms=8)
        ax.axhline(0, color="k", lw=0.6)
        ax.set_title(f"{c.share:.0%} of what it does", fontsize=9)
        ax.set(xlabel=label, ylabel=f"joint {c.joint} off by (mrad)")
    return plain(figure)


def _along(c: JointCurve) -> tuple[str, Array, Array]:
    """The axis of a joint's course, where the course is told and where the views stood along it."""
    if c.covariate != "time_s":
        return covariate(c.covariate), c.at, c.view_values
    first = float(c.view_values.min())
    unit, of_second = _unit_of(float(np.ptp(c.view_values)))
    return unit, (c.at - first) * of_second, (c.view_values - first) * of_second


def time_course(found: Diagnosis, curve: TimeCurve, length_unit: str) -> Figure:
    """How far the flange turns and moves in time along its own axes, with two sigmas."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    unit, of_step = _times(curve)
    stood = time_in_steps(found.linear.measurement)
    for ax, of, factor in ((axes[0], ROTATION_PART, 1e3), (axes[1], TRANSLATION_PART, MICROMETRES[length_unit])):
        _banded(ax, (curve.steps - curve.steps[0]) * of_step, factor * curve.error[:, of], factor * curve.sigma[:, of])
        ax.plot((stood - stood.min()) * of_step, np.zeros(len(stood)), "|", color="k", ms=8)
        ax.axhline(0, color="k", lw=0.6)
    axes[0].set_ylabel("turned (mrad)")
    axes[1].set(ylabel="moved (µm)", xlabel=unit)
    above(axes[0])
    return plain(figure)


def _times(curve: TimeCurve) -> tuple[str, float]:
    """What the time axis counts, and how much of it a step is."""
    if not curve.seconds:
        return "view", 1.0
    unit, of_second = _unit_of(curve.seconds * float(np.ptp(curve.steps)))
    return unit, curve.seconds * of_second


def _unit_of(whole: float) -> tuple[str, float]:
    """What the time of a session of so many seconds is told in, and how much of it a second is."""
    return ("hours", 1 / 3600) if whole > _HOURS_FROM else ("minutes", 1 / 60)


def _banded(ax: Axes, time: Array, error: Array, sigma: Array) -> None:
    """One line with its band for each axis of the flange."""
    for k, (name, colour) in enumerate(_AXES):
        ax.fill_between(
            time, error[:, k] - 2 * sigma[:, k], error[:, k] + 2 * sigma[:, k], color=colour, alpha=0.18, lw=0
        )
        ax.plot(time, error[:, k], color=colour, label=f"axis {name}")
