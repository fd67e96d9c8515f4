"""Every parameter of a cell over time, as drawings in the page itself: they follow its colours, light or dark.

Drawn without a plotting library: a page of thousands of sessions has to stand within two seconds.
"""

from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape

import numpy as np
from numpy.typing import NDArray

from stitch.plugins.watch.report import CellTrend, day_text, table_unit

# Round numbers for axes: of values, and of times.

_ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)
# Seconds between marks of time, and how they are written.
_TIMES = (
    (3600.0, "%H:%M"),
    (3 * 3600.0, "%H:%M"),
    (6 * 3600.0, "%d %b %H:%M"),
    (86400.0, "%d %b"),
    (2 * 86400.0, "%d %b"),
    (7 * 86400.0, "%d %b"),
    (14 * 86400.0, "%d %b"),
    (28 * 86400.0, "%d %b"),
    (91 * 86400.0, "%b %Y"),
    (365 * 86400.0, "%Y"),
)


def value_marks(low: float, high: float, most: int = 4) -> list[tuple[float, str]]:
    """Round values between two, with their texts."""
    rough = (high - low) / most
    if not np.isfinite(rough) or rough <= 0:
        return [(low, f"{low:.4g}")]
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * r for r in _ROUND if power * r >= rough)
    marks = step * np.arange(np.ceil(low / step), np.floor(high / step) + 1)
    digits = max(0, int(-np.floor(np.log10(step) + 1e-9)) + (step / power == 2.5))
    big = max(abs(low), abs(high)) >= 1e5 or step < 1e-4
    return [(float(x), f"{x:.4g}" if big else f"{x + 0.0:.{digits}f}") for x in marks]


def time_marks(first: float, last: float, most: int = 5) -> list[tuple[float, str]]:
    """Round times (s since 1970, UTC) between two, with their texts."""
    step, form = next(((s, f) for s, f in _TIMES if (last - first) / s <= most), _TIMES[-1])
    marks = step * np.arange(np.ceil(first / step), np.floor(last / step) + 1)
    return [(float(t), datetime.fromtimestamp(t, UTC).strftime(form)) for t in marks]


Array = NDArray[np.float64]

_WIDTH, _HEIGHT = 340.0, 170.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 48.0, 8.0, 8.0, 20.0
# Beyond two sigmas of the smoothed value one in twenty should lie.
_BAND = 2.0


class Axes:
    """A drawing with its scales."""

    def __init__(self, times: Array, low: float, high: float, height: float = _HEIGHT, width: float = _WIDTH) -> None:
        self.height, self.width = height, width
        self.first, self.last = float(times[0]), float(max(times[-1], times[0] + 1.0))
        room = 0.06 * max(high - low, 1e-12 * max(abs(low), abs(high), 1e-300))
        self.low, self.high = low - room, high + room
        self.parts: list[str] = []

    def x(self, times: Array | float) -> Array:
        """Places of times."""
        share = (np.asarray(times, float) - self.first) / (self.last - self.first)
        return np.asarray(_LEFT + share * (self.width - _LEFT - _RIGHT))

    def y(self, values: Array | float) -> Array:
        """Places of values, kept inside."""
        share = np.clip((np.asarray(values, float) - self.low) / (self.high - self.low), 0.0, 1.0)
        return np.asarray(self.height - _BOTTOM - share * (self.height - _TOP - _BOTTOM))

    def marks(self) -> None:
        """Scales with their lines."""
        bottom, right = self.height - _BOTTOM, self.width - _RIGHT
        for value, text in value_marks(self.low, self.high):
            y = float(self.y(value))
            self.parts.append(f'<path class="grid" d="M{_LEFT:g},{y:.1f}H{right:g}"/>')
            self.parts.append(f'<text x="{_LEFT - 5:g}" y="{y + 3.5:.1f}" text-anchor="end">{text}</text>')
        for time, text in time_marks(self.first, self.last):
            x = float(self.x(time))
            self.parts.append(f'<text x="{x:.1f}" y="{self.height - 5:g}" text-anchor="middle">{text}</text>')
            self.parts.append(f'<path class="grid" d="M{x:.1f},{bottom:g}v4"/>')

    def line(self, kind: str, times: Array, values: Array) -> None:
        """A line through values; gaps where one is not known."""
        seen = np.isfinite(values)
        told = zip(self.x(times[seen]), self.y(values[seen]), strict=True)
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in told)
        self.parts.append(f'<polyline class="{kind}" points="{points}"/>')

    def dots(self, times: Array, values: Array) -> None:
        """A dot for each value."""
        seen = np.isfinite(values)
        told = zip(self.x(times[seen]), self.y(values[seen]), strict=True)
        self.parts.append(f'<path class="dots" d="{"".join(f"M{x:.1f},{y:.1f}h0" for x, y in told)}"/>')

    def band(self, times: Array, low: Array, high: Array) -> None:
        """The room between two lines."""
        x = np.concatenate([self.x(times), self.x(times)[::-1]])
        y = np.concatenate([self.y(low), self.y(high)[::-1]])
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True) if np.isfinite(b))
        self.parts.append(f'<polygon class="band" points="{points}"/>')

    def level(self, kind: str, value: float) -> None:
        """A line across, where it lies inside."""
        if self.low <= value <= self.high:
            y = float(self.y(value))
            self.parts.append(f'<path class="{kind}" d="M{_LEFT:g},{y:.1f}H{self.width - _RIGHT:g}"/>')

    def moment(self, kind: str, time: float, told: str) -> None:
        """A line upright, with words for whoever points at it."""
        x = float(self.x(time))
        line = f"M{x:.1f},{_TOP:g}V{self.height - _BOTTOM:g}"
        self.parts.append(f'<path class="{kind}" d="{line}"><title>{escape(told)}</title></path>')

    def svg(self, label: str) -> str:
        """The drawing as an element."""
        head = (
            f'<svg class="course" viewBox="0 0 {self.width:g} {self.height:g}" role="img" aria-label="{escape(label)}">'
        )
        return head + "".join(self.parts) + "</svg>"


def parameter_drawing(course: CellTrend, p: int) -> tuple[str, str]:
    """Title and drawing of one parameter."""
    report = course.report.parameters[p]
    factor, unit = table_unit(report.unit, course.report.length_unit)
    found, middle, sigma = (x[:, p] * factor for x in (course.values, course.smoothed, course.smoothed_sigmas))
    low, high = middle - _BAND * sigma, middle + _BAND * sigma
    ends = np.nanquantile(np.concatenate([found, low, high]), [0.003, 0.997])
    axes = Axes(course.times, *(float(x) for x in ends))
    axes.marks()
    axes.band(course.times, low, high)
    axes.dots(course.times, found)
    axes.line("smooth", course.times, middle)
    used, limit = course.in_use[p] * factor, report.limit * factor
    for kind, value in (("used", used), ("limit", used - limit), ("limit", used + limit)):
        axes.level(kind, value)
    for change in report.changes:
        since = course.report.run_times[change.since]
        if since >= course.times[0]:
            told = f"{change.kind} before session {course.report.run_names[change.since]}, {day_text(since)}"
            axes.moment(change.kind, since, told)
    return f"{report.name} ({unit})", axes.svg(f"{report.name} over time")


def channel_drawing(times: Array, values: Array, name: str) -> str:
    """A channel over the same time."""
    seen = values[np.isfinite(values)]
    axes = Axes(times, float(seen.min()), float(seen.max()), height=120.0)
    axes.marks()
    axes.line("channel", times, values)
    return axes.svg(f"{name} over time")


def drawings(course: CellTrend, parameters: Sequence[int]) -> list[tuple[str, str, bool]]:
    """Title, drawing and whether an alarm stands, of some parameters."""
    return [(*parameter_drawing(course, p), course.report.parameters[p].alarm is not None) for p in parameters]
