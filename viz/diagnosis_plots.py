"""What a diagnosis draws below the screen, as numbers for the page's own plots: courses, maps, the variance budget."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.residual_structure import NOT_REPEATING, BudgetLine
from stitch.diagnosis.unmodelled_joint_effects import JointCurve
from stitch.diagnosis.unmodelled_time_effects import ROTATION_PART, TRANSLATION_PART, TimeCurve
from stitch.numerics.frames import Array
from stitch.numerics.units import MICROMETRES, covariate_text, length_text
from stitch.observations.pose_errors import time_in_steps
from stitch.observations.surfaces.field_error import FieldMap
from stitch.output.comparison.residual_tables import ResidualTable, ResidualTables
from stitch.output.plain_finding import OTHER_SOURCES, largest_error_sources, share_text
from viz import captions

_HOURS_FROM = 7200.0  # s that are better told in hours than in minutes
_PLOT_HEIGHT = 170
# Curves, dependences and properties that are drawn.
_MAX_CURVES, _MAX_DEPENDENCES, _MAX_PROPERTIES = 3, 3, 9


@dataclass(frozen=True)
class Plots:
    """Some plots with one caption; each is what `drawn_plots.js` draws."""

    title: str
    caption: str
    plots: tuple[dict[str, Any], ...]


def diagnosis_plots(found: Diagnosis, length_unit: str) -> list[Plots]:
    """Return the plots of a diagnosis in the order of the page, those with nothing to draw left out."""
    um = MICROMETRES[length_unit]
    told = [
        Plots(
            "Where and when a joint errs without a name",
            captions.COURSES,
            tuple(_joint_course(curve) for curve in found.curves[:_MAX_CURVES]),
        )
    ]
    if found.time_curve is not None:
        plots = tuple(_time_courses(found, found.time_curve, um))
        told.append(Plots("When in the session poses err without a name", captions.TIME_COURSE, plots))
    if found.scanner_error is not None and found.scanner_error.map is not None:
        told.append(_scanner_field(found.scanner_error.map, length_unit))
    panels = tuple(
        _panel(
            d.bins, d.mean * um, d.sigma * um, f"{covariate_text(d.covariate)}, p = {d.p_value:.1g}", "displaced (µm)"
        )
        for d in found.depends_on[:_MAX_DEPENDENCES]
    )
    told.append(Plots("What the unexplained displacement follows", captions.SHAPE, panels))
    return [one for one in told if one.plots]


def comparison_plots(found: ResidualTables, length_unit: str) -> tuple[dict[str, Any], ...]:
    """Return the signed mean distance between the views against the clearest properties, with two sigmas."""
    um = MICROMETRES[length_unit]

    def against(table: ResidualTable) -> dict[str, Any]:
        label = f"{table.name}{f' ({table.unit})' if table.unit else ''}"
        return _panel((table.low + table.high) / 2, table.mean * um, table.mean_sigma * um, label, "mean (µm)")

    return tuple(against(table) for table in found.places[:_MAX_PROPERTIES])


def _panel(x: Array, y: Array, sigma: Array, label: str, of: str) -> dict[str, Any]:
    """Dots with two sigmas, joined by a line."""
    known = np.isfinite(x) & np.isfinite(y)
    own = _series("line", x[known], y[known]) | {"tint": "0"}
    dots = _series("dots", x[known], y[known], np.nan_to_num(sigma[known])) | {"tint": "0"}
    return {"x": {"label": label}, "y": {"label": of}, "height": _PLOT_HEIGHT, "series": [own, dots]}


def _series(kind: str, x: Array, y: Array, sigma: Array | None = None) -> dict[str, Any]:
    rounded = {"x": _numbers(x), "y": _numbers(y)} | ({} if sigma is None else {"sigma": _numbers(sigma)})
    return {"kind": kind} | rounded


def _numbers(values: Array) -> list[float]:
    return [float(f"{x:.5g}") for x in values]


def _joint_course(c: JointCurve) -> dict[str, Any]:
    """The errors of a joint that match no effect along what they follow, with two sigmas."""
    label, at, stood = _along(c)
    share = f"{label}: {c.share:.0%} of what joint {c.joint} does".replace("%", " %")
    series = [
        _series("band", at, 1e3 * c.error, 1e3 * c.sigma) | {"tint": "0"},
        _series("line", at, 1e3 * c.error) | {"tint": "0"},
        {"kind": "ticks", "x": _numbers(stood)},
    ]
    return {"x": {"label": share}, "y": {"label": f"joint {c.joint} off by (mrad)"}, "height": 200, "series": series}


def _along(c: JointCurve) -> tuple[str, Array, Array]:
    """The axis of a joint's course, where the course is told and where the views stood along it."""
    if c.covariate != "time_s":
        return covariate_text(c.covariate), c.at, c.view_values
    first = float(c.view_values.min())
    unit, of_second = _unit_of(float(np.ptp(c.view_values)))
    return unit, (c.at - first) * of_second, (c.view_values - first) * of_second


def _unit_of(whole: float) -> tuple[str, float]:
    """Return the unit of time for a session of so many seconds, and its units per second."""
    return ("hours", 1 / 3600) if whole > _HOURS_FROM else ("minutes", 1 / 60)


def _time_courses(found: Diagnosis, curve: TimeCurve, um: float) -> Iterator[dict[str, Any]]:
    """Rotation and displacement of the flange in time along its own axes, with two sigmas."""
    unit, of_step = "view", 1.0
    if curve.seconds:
        unit, of_second = _unit_of(curve.seconds * float(np.ptp(curve.steps)))
        of_step = curve.seconds * of_second
    at = (curve.steps - curve.steps[0]) * of_step
    stood = time_in_steps(found.linear.measurement)
    ticks = {"kind": "ticks", "x": _numbers((stood - stood.min()) * of_step)}
    for part, factor, label in ((ROTATION_PART, 1e3, "turned (mrad)"), (TRANSLATION_PART, um, "moved (µm)")):
        error, sigma = factor * curve.error[:, part], factor * curve.sigma[:, part]
        bands = [_series("band", at, error[:, k], sigma[:, k]) | {"tint": str(k)} for k in range(3)]
        lines = [_series("line", at, error[:, k]) | {"tint": str(k)} for k in range(3)]
        axes = f"{unit}; axes x orange, y green, z blue"
        yield {"x": {"label": axes}, "y": {"label": label}, "height": 190, "series": [*bands, *lines, ticks]}


def _scanner_field(found: FieldMap, length_unit: str) -> Plots:
    """Error along the ray by the direction of the ray, blue too near, red too far; beside it its sigma."""
    um = MICROMETRES[length_unit]
    x, y = (_numbers(np.degrees(np.arctan(way))) for way in (found.x, found.y))
    limit, highest = (float(np.nanmax(np.abs(values))) * um for values in (found.error, found.sigma))

    def drawn(values: Array, low: float, high: float, colours: str, label: str) -> dict[str, Any]:
        rows = [[round(v, 3) if np.isfinite(v) else None for v in row] for row in (values * um).tolist()]
        return {"x": x, "y": y, "values": rows, "low": low, "high": high, "colours": colours, "label": label}

    size, sigma = (length_text(value, length_unit, 2) for value in (found.rms, found.uncertainty))
    plots = (
        drawn(found.error, -limit, limit, "signed", "Error along the ray over the scanner's field"),
        drawn(found.sigma, 0.0, highest, "field", "Standard uncertainty of it"),
    )
    return Plots("How the scanner errs over its field", captions.SCANNER_FIELD.format(size=size, sigma=sigma), plots)


# Where the error comes from: a bar for each source.


class BudgetRow(NamedTuple):
    """One source of what the poses leave."""

    source: str
    share: float  # of the variance, %
    told: str  # share and size
    kind: str  # what it is, in the words of the legend


def budget_rows(found: Diagnosis, length_unit: str) -> list[BudgetRow]:
    """Return the largest sources of the variance; of a session without a budget the shares of the mean square."""
    lines = largest_error_sources(found.budget)
    if not lines:
        return _mean_squares(found, length_unit)
    return [
        BudgetRow(
            line.source,
            100 * line.variance_share,
            f"{share_text(line)}, {length_text(line.sigma, length_unit, 2)}",
            _kind(found, line),
        )
        for line in lines
    ]


def _kind(found: Diagnosis, line: BudgetLine) -> str:
    if line.source in found.effects:
        return "named above as missing"
    if line.source in found.linear.model.effects:
        return "in the model, corrected"
    return "noise, scatter" if line.source in (*NOT_REPEATING, OTHER_SOURCES) else "repeats, without a name"


def _mean_squares(found: Diagnosis, length_unit: str) -> list[BudgetRow]:
    """Mean squares between the views: sensor noise, what the named effects explain, the rest."""
    total, noise = found.residual_rms**2, found.noise_floor**2
    validations = [c.cross_validation for c in found.candidates if c.name in found.effects]
    share = next((v.inside for v in validations if v is not None), 1.0)
    explained = max(total * (1 - share), 0.0)
    parts = [
        ("sensor noise", min(noise, total), "noise, scatter"),
        (", ".join(found.effects) or "explained", explained, "named above as missing"),
        ("scatter of the poses and the rest", max(total - noise - explained, 0.0), "noise, scatter"),
    ]
    return [
        BudgetRow(name, 100 * size / total, length_text(size**0.5, length_unit, 2), kind)
        for name, size, kind in parts
        if size > 0
    ]


# Aliases: the share of each candidate's pattern that the others can imitate.

_MAX_ALIASES = 12
# Imitated by less than this, an effect is told apart.
_TOLD_APART = 0.5


def alias_rows(found: Diagnosis) -> list[tuple[str, list[tuple[int, str]]]]:
    """Return name and, for every candidate in turn, per cent that it can imitate with its text where that counts."""
    keep = [k for k, c in enumerate(found.candidates) if c.ranked.score.observable][:_MAX_ALIASES]
    return [
        (
            found.candidates[i].name,
            [(round(100 * x), f"{x:.2f}" if x >= _TOLD_APART else "") for x in found.matrix[i, keep]],
        )
        for i in keep
    ]
