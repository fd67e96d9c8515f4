"""How a flange may err in time by one shape: swings to and fro, and stretches of views after which it comes back."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from stitch.diagnosis.unknown.smooth_processes import SmoothProcess
from stitch.frames import Array
from stitch.observations.flange_errors import flange_twists, time_in_steps, usual_time_step
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


# Periods between those that are tried, where one of them is clear.
_PERIOD_REFINEMENT = 17
# Of a swing in which all that moves does so at once: one of these is within a sixteenth of a period of any phase.
_PHASES = 8
# Times (T,) in steps from view to view → shapes (T, R) of a process.
_TimeCourse = Callable[[Array], Array]
_DescribedCourse = tuple[
    str, str, _TimeCourse, float | None
]  # its kind, in words, and with its frequency if it is a swing
_SWING, _SWING_IN_PHASE, _STRETCH = "swing", "swing at once", "stretch"


@dataclass(frozen=True)
class TimeProcess:
    """A motion of the flange in one course of time."""

    kind: str
    words: str  # what they do: "they …"
    process: SmoothProcess
    course: _TimeCourse
    frequency: float | None = None  # 1/step, of a swing


def time_processes(linear: LinearModel) -> list[TimeProcess]:
    """All that are tried, of any size and direction in the flange's frame."""
    time = time_in_steps(linear.measurement)
    span = _span(time)
    apart = max(_APART / span, _FASTEST / _MOST_FREQUENCIES)
    frequencies = np.arange(_LEAST_SWINGS / span, _FASTEST, apart)
    at_once = _swings_in_phase(linear, frequencies)
    return _processes(linear, time, [*_swings(linear, frequencies), *at_once, *_stretches(linear, time)])


def processes_near_period(linear: LinearModel, swing: TimeProcess) -> list[TimeProcess]:
    """A swing, and others between it and the next ones that are tried."""
    assert swing.frequency is not None
    time = time_in_steps(linear.measurement)
    reach = _APART / _span(time)
    return _processes(linear, time, _swings(linear, swing.frequency + np.linspace(-reach, reach, _PERIOD_REFINEMENT)))


def _span(time: Array) -> float:
    """Of the session in steps, one at the least."""
    return max(float(np.ptp(time)), 1.0)


def _processes(linear: LinearModel, time: Array, courses: Iterable[_DescribedCourse]) -> list[TimeProcess]:
    carried = flange_twists([linear.measurement], [linear.observation.centre]).reshape(len(time), 6, 6)
    return [
        TimeProcess(kind, words, SmoothProcess(None, carried, course(time)), course, frequency)
        for kind, words, course, frequency in courses
    ]


def _swings(linear: LinearModel, frequencies: Array) -> Iterator[_DescribedCourse]:
    """Sines, of another phase in each motion, in words."""
    for f in map(float, frequencies):
        yield _SWING, f"swing to and fro about every {_duration_in_words(linear, 1 / f)}", partial(_waves, f), f


def _swings_in_phase(linear: LinearModel, frequencies: Array) -> Iterator[_DescribedCourse]:
    """The same with one phase for all motions, as where one temperature moves them: half as many numbers."""
    for _, words, waves, f in _swings(linear, frequencies):
        for phase in np.arange(_PHASES) * np.pi / _PHASES:
            yield _SWING_IN_PHASE, words, partial(_wave, waves, phase), f


def _waves(frequency: float, time: Array) -> Array:
    """(T, 2) of which all sines of a frequency (1/step) are made."""
    phase = 2 * np.pi * frequency * time
    return np.stack([np.cos(phase), np.sin(phase)], axis=1)


def _wave(waves: _TimeCourse, phase: float, time: Array) -> Array:
    """(T, 1) the one of them with a phase."""
    return np.asarray(waves(time) @ np.array([[np.cos(phase)], [np.sin(phase)]]))


def _stretches(linear: LinearModel, time: Array) -> Iterator[_DescribedCourse]:
    """Bumps that begin and end within the session, in words."""
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
                words = f"are off for a stretch of {_duration_in_words(linear, _FULL_WIDTH * width)} about view {name}"
                yield _STRETCH, words, partial(_bump, middle, width), None
        width *= 2


def _bump(middle: float, width: float, time: Array) -> Array:
    """(T, 1) of unit height, with its standard deviation `width`."""
    return np.asarray(np.exp(-0.5 * ((time - middle) / width) ** 2)[:, None])


def _duration_in_words(linear: LinearModel, steps: float) -> str:
    """A time in steps from view to view, in words."""
    step = usual_time_step(linear.measurement)
    return f"{steps:.2g} views" + (f" ({duration_text(steps * step)})" if step > 0 else "")
