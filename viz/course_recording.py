"""Why, in a recording: the course of an effect as a drawing of its own, and the arms of the cell in its colours."""

from collections.abc import Callable
from typing import Any

import numpy as np
import rerun as rr

from stitch.numerics.frames import Array
from stitch.numerics.units import covariate_text
from viz.colours import signed_colours

# Width and height of the drawing, in its own units; y points downwards. As long as an ordinary window has room.
_WIDE, _HIGH = 170.0, 22.0
_LEFT, _BELOW, _ABOVE = 12.0, 5.0, 3.0
# Letters that stand side by side along the drawing; what is longer would cover what is beside it.
_LETTERS = 110
_DOTS, _LINE, _WHISKER, _AXIS = (232, 235, 239), (230, 159, 0), (150, 155, 160), (110, 115, 120)
_GRID = (52, 57, 63)
WHERE = "diagnosis/why"
X_RANGE, Y_RANGE = (-2.0, _LEFT + _WIDE + 3.0), (-_ABOVE - 2.0, _HIGH + _BELOW + 1.0)


def log_no_course(recording: rr.RecordingStream, told: str) -> None:
    """Say that nothing is known yet where the drawing will stand."""
    _label(recording, "title", [(_LEFT + _WIDE / 2, _HIGH / 2)], [told])


def log_course(recording: rr.RecordingStream, course: dict[str, Any], names: list[str], um: float) -> None:
    """Draw a course of diagnosis.json, dots and line between two sigmas; colour the arms by the dots.

    Args:
        um: micrometres in one length_unit.
    """
    factor, unit = (1e3, "mrad") if course["value_unit"] == "rad" else (um, "µm")
    at = np.array(course["at"])
    values = ("measured", "sigma", "predicted", "predicted_sigma")
    measured, sigma, predicted, band = (np.array(course[key]) * factor for key in values)
    low = min(float((measured - 2 * sigma).min()), float(predicted.min()), 0.0)
    high = max(float((measured + 2 * sigma).max()), float(predicted.max()), 0.0)
    to_x, to_y = _scales(at, low, high)
    x = to_x(at)
    order = np.argsort(x, kind="stable")
    lines = [np.column_stack([x, to_y(predicted + s * 2 * band)])[order] for s in (0, -1, 1)]
    for name, strips, width in (("line", lines[:1], 1.5), ("band", lines[1:], 0.5)):
        drawn = rr.LineStrips2D(strips, colors=[_LINE], radii=rr.Radius.ui_points(width))
        recording.log(f"{WHERE}/{name}", drawn, static=True)
    ends = np.stack([np.column_stack([x, to_y(measured + s * 2 * sigma)]) for s in (-1, 1)], axis=1)
    recording.log(
        f"{WHERE}/sigma", rr.LineStrips2D(list(ends), colors=[_WHISKER], radii=rr.Radius.ui_points(0.7)), static=True
    )
    dots = rr.Points2D(np.column_stack([x, to_y(measured)]), colors=[_DOTS], radii=rr.Radius.ui_points(4.0))
    recording.log(f"{WHERE}/dots", dots, static=True)
    zero = [[_LEFT, float(to_y(np.zeros(1))[0])], [_LEFT + _WIDE, float(to_y(np.zeros(1))[0])]]
    recording.log(f"{WHERE}/zero", rr.LineStrips2D([zero], colors=[_AXIS], radii=rr.Radius.ui_points(0.7)), static=True)
    follows = "views in their order" if course["follows"] == "view order" else covariate_text(course["follows"])
    along = f"{follows} ({course['unit']})" if course["unit"] else follows
    verb = "are" if course["of"].endswith("views") else "is"
    title = f"how far {course['of']} {verb} off ({unit}), over {along}"
    _label(recording, "title", [(_LEFT + _WIDE / 2, -_ABOVE)], [title])
    heights = round_marks(low, high, 4)
    texts = [f"{h:+.3g}" if h else "0" for h in heights]
    _label(recording, "heights", np.column_stack([np.full(len(heights), _LEFT / 2), to_y(heights)]), texts)
    in_order = course["follows"] == "view order" and course["views"]
    marks = at if in_order else round_marks(float(at.min()), float(at.max()), 8)
    told = [names[v] for v in course["views"]] if in_order else [f"{mark:.6g}" for mark in marks]
    some = apart(to_x(marks), (max(map(len, told), default=0) + 2) * _WIDE / _LETTERS)
    below = np.column_stack([to_x(marks[some]), np.full(len(some), _HIGH + _BELOW / 2)])
    _label(recording, "names", below, [told[i] for i in some])
    grid = [[[_LEFT, float(y)], [_LEFT + _WIDE, float(y)]] for y in to_y(heights)]
    grid += [[[float(x), 0.0], [float(x), _HIGH]] for x in to_x(marks[some])]
    drawn = rr.LineStrips2D(grid, colors=[_GRID], radii=rr.Radius.ui_points(0.4))
    recording.log(f"{WHERE}/grid", drawn, static=True)
    if len(course["views"]) == len(names):
        colours = signed_colours(measured, float(np.abs(measured).max()))
        recording.log("robot/flanges", rr.Points3D.from_fields(colors=colours), static=True)
        recording.log("robot/arm", rr.LineStrips3D.from_fields(colors=colours), static=True)


def apart(x: Array, least: float) -> list[int]:
    """Return which of the places x (N,) may be named, from the left: no two are closer than `least`."""
    kept: list[int] = []
    for i in np.argsort(x, kind="stable").tolist():
        if not kept or x[i] - x[kept[-1]] >= least:
            kept.append(i)
    return kept


def round_marks(low: float, high: float, most: int) -> Array:
    """Return at most so many round numbers from low to high at equal steps: 1, 2 or 5 with zeros."""
    least = max(high - low, 1e-12) / most
    power = 10.0 ** np.floor(np.log10(least))
    step = next(x * power for x in (1, 2, 5, 10) if x * power >= least * (1 - 1e-9))
    return step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 0.5) + 0.0


_Scale = Callable[[Array], Array]


def _scales(at: Array, low: float, high: float) -> tuple[_Scale, _Scale]:
    """Return how numbers become places along the drawing, and how values from low to high become heights."""
    size = (high - low) or 1.0

    def to_x(places: Array) -> Array:
        return _LEFT + _WIDE * (places - at.min()) / (float(np.ptp(at)) or 1.0)

    def to_y(values: Array) -> Array:
        return _HIGH * (high - values) / size

    return to_x, to_y


def _label(recording: rr.RecordingStream, name: str, places: Any, texts: list[str]) -> None:
    shown = rr.Points2D(
        places, labels=texts, colors=[(200, 204, 210)], radii=rr.Radius.ui_points(0.1), show_labels=True
    )
    recording.log(f"{WHERE}/{name}", shown, static=True)
