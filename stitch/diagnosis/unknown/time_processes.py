"""How a flange may err in time by one shape: swings to and fro, and stretches of views after which it comes back."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.unknown.smooth_processes import SmoothProcess
from stitch.frames import Array
from stitch.observations.flange_errors import flange_twists, in_steps, usual_step
from stitch.observations.linear_model import LinearModel
from stitch.units import duration_text

# Whole swings that a session must have seen, and per step: faster ones look like slower ones.
_LEAST_SWINGS, _FASTEST = 2.0, 0.45
# Frequencies nearer to each other than half a swing over the session look alike; of a session with long breaks there
# would be thousands.
_APART, _MOST_FREQUENCIES = 0.5, 150
# Standard deviation of the shortest stretch in steps, and of the longest as a share of the session; views in each.
_SHORTEST, _LONGEST, _LEAST_VIEWS = 1.5, 0.2, 2
# Of a Gaussian its full width at half maximum.
_FULL_WIDTH = 2.355


@dataclass(frozen=True)
class TimeProcess:
    """A motion of the flange in one course of time."""

    words: str  # what they do: "they …"
    process: SmoothProcess


def time_processes(linear: LinearModel) -> list[TimeProcess]:
    """All that are tried, of any size and direction in the flange's frame."""
    time = in_steps(linear.measurement)
    carried = flange_twists([linear.measurement], [linear.observation.centre]).reshape(len(time), 6, 6)
    courses = [*_swings(linear, time), *_stretches(linear, time)]
    return [TimeProcess(words, SmoothProcess(None, carried, shapes)) for words, shapes in courses]


def _swings(linear: LinearModel, time: Array) -> Iterator[tuple[str, Array]]:
    """Sines of any phase: words and shapes (V, 2)."""
    span = max(float(np.ptp(time)), 1.0)
    for frequency in np.arange(_LEAST_SWINGS / span, _FASTEST, max(_APART / span, _FASTEST / _MOST_FREQUENCIES)):
        phase = 2 * np.pi * frequency * time
        shapes = np.stack([np.cos(phase), np.sin(phase)], axis=1)
        yield f"swing to and fro about every {_lasting(linear, 1 / frequency)}", shapes


def _stretches(linear: LinearModel, time: Array) -> Iterator[tuple[str, Array]]:
    """Bumps that begin and end within the session: words and shapes (V, 1)."""
    first, last, width = float(time.min()), float(time.max()), _SHORTEST
    views = linear.measurement.views
    while width <= _LONGEST * (last - first):
        # A grid of this width within the session, where there are views: it may hold breaks of days.
        steps = np.floor((time - first) / width)
        middles = first + width * np.unique([steps, steps + 1])
        for middle in middles[(middles > first) & (middles < last - width / 2)]:
            away = np.abs(time - middle) / width
            if np.count_nonzero(away < _FULL_WIDTH / 2) >= _LEAST_VIEWS:
                name = views.names[views.number[away.argmin()]]
                words = f"are off for a stretch of {_lasting(linear, _FULL_WIDTH * width)} about view {name}"
                yield words, np.exp(-0.5 * away**2)[:, None]
        width *= 2


def _lasting(linear: LinearModel, steps: float) -> str:
    """A time in steps from view to view, in words."""
    step = usual_step(linear.measurement)
    return f"{steps:.2g} views" + (f" ({duration_text(steps * step)})" if step > 0 else "")
