"""The page of a cell over days: one sentence, until when the calibration holds, every parameter over time."""

from collections.abc import Sequence
from os.path import relpath
from pathlib import Path
from typing import Any

import numpy as np

from stitch.numerics.units import covariate_text, covariate_unit, rounded
from stitch.plugins.watch.report import (
    CellReport,
    CellTrend,
    FollowedChannel,
    ParameterReport,
    day_text,
    event_sentences,
    report_notes,
    size_text,
    table_unit,
    uncertainty_note,
)
from stitch.system.files import whole_file
from stitch.system.packages import stitch_version
from viz import captions
from viz.page_parts import render
from viz.watch.small_multiples import channel_drawing, drawings

# Parameters that are drawn before the others are folded.
_FIRST = 6


def write_page(course: CellTrend, path: Path) -> None:
    """Write the page of a cell; it needs nothing beside it."""
    report = course.report
    order = sorted(range(len(report.parameters)), key=lambda p: _urgency(report, report.parameters[p]))
    moved = sum(p.alarm is not None for p in report.parameters)
    first = max(min(_FIRST, len(order)), moved)
    page = render(
        "watch.html.j2",
        report=report,
        light=light(report),
        events=[told[0].upper() + told[1:] if told.startswith("the ") else told for told in event_sentences(report)],
        notes=report_notes(report),
        identity=_identity(report),
        rows=[_row(report, report.parameters[p]) for p in order],
        first=drawings(course, order[:first]),
        rest=drawings(course, order[first:]),
        channels=[
            (covariate_text(name), channel_drawing(course.times, values, name))
            for name, values in course.channels.items()
            if np.isfinite(values).any()
        ],
        past=_past(report),
        shown=len(course.times),
        caption=captions.WATCHED,
    )
    with whole_file(path) as file:
        file.write_text(page, encoding="utf-8")


def light(report: CellReport) -> tuple[str, str]:
    """Colour of a light, and what it says."""
    end = report.recalibrate_before
    if end is not None and end <= report.last:
        return "bad", "The calibration in use does not hold any more: recalibrate now."
    if report.too_uncertain:
        return "check", f"{uncertainty_note(report)}."
    if report.alarms:
        until = "" if end is None else f" Recalibrate before {day_text(end)}."
        return "check", f"Something moves; the calibration in use still holds.{until}"
    if end is not None:
        return "good", f"Nothing moves. Recalibrate before {day_text(end)}."
    return "good", "Nothing moves; the calibration in use holds for half a year at least."


def _urgency(report: CellReport, p: ParameterReport) -> tuple[bool, float, float]:
    """Alarms first, by their onset; then what leaves its limits first."""
    since = np.inf if p.alarm is None else report.run_times[p.alarm.since]
    return p.alarm is None, since, np.inf if p.valid_until is None else p.valid_until


def _identity(report: CellReport) -> list[tuple[str, str]]:
    return [
        ("Cell", report.name),
        ("Sessions", f"{report.sessions:,}"),
        ("First", f"{day_text(report.first)} UTC"),
        ("Last", f"{day_text(report.last)} UTC"),
        ("Calibration in use", report.in_use),
        ("False alarms", f"limits for one of the whole cell in {report.run_length:,.0f} sessions"),
        ("stitch", stitch_version()),
    ]


def _row(report: CellReport, p: ParameterReport) -> dict[str, Any]:
    factor, unit = table_unit(p.unit, report.length_unit)
    moves = abs(p.drift_per_day) > 3 * p.drift_sigma
    until = _until(p.valid_until, report, p.too_uncertain)
    return {
        "name": p.name,
        "unit": unit,
        "value": rounded(factor * p.value, factor * p.sigma / 10),
        "sigma": f"{factor * p.sigma:.2g}",
        "drift": rounded(factor * p.drift_per_day, factor * p.drift_sigma) if moves else "–",
        "follows": "; ".join(_follows(f, factor, unit) for f in p.follows),
        "limit": f"{factor * p.limit:.3g}" if np.isfinite(p.limit) else "–",
        "until": until,
        "scatter": f"{p.scatter:.2f}",
        "alarm": p.alarm is not None,
    }


def _follows(followed: FollowedChannel, factor: float, unit: str) -> str:
    """Return a channel with the share of it that a parameter follows."""
    name = followed.channel.removesuffix("_c").replace("_", " ")
    return f"{name}: {factor * followed.per_unit:.2g} {unit}/{covariate_unit(followed.channel) or 'unit'}"


def _past(report: CellReport) -> list[dict[str, str]]:
    """Every change, latest first."""
    own = [(p, c) for p in report.parameters for c in p.changes]
    own.sort(key=lambda item: -report.run_times[item[1].since])
    return [
        {
            "name": p.name,
            "since": f"{report.run_names[c.since]}, {day_text(report.run_times[c.since])}",
            "raised": report.run_names[c.raised],
            "kind": c.kind if c.channel is None else f"follows {c.channel}",
            "size": size_text(c.size, p.unit, c.sigma) + (" a day" if c.kind == "drift" and c.channel is None else ""),
            "sigma": size_text(float(f"{c.sigma:.2g}"), p.unit),
            "chart": c.chart,
            "stands": "stands" if c is p.alarm else "",
        }
        for p, c in own
    ]


# The page of a plant: a row a cell, those first that need somebody.

_ORDER = ("bad", "check", "good")


def write_plant_page(cells: Sequence[tuple[CellReport, Path]], path: Path) -> None:
    """Write the page of some cells with links to theirs.

    Args:
        cells: what each has to say, and where its page lies.
    """
    rows = [
        {
            "name": report.name,
            "href": Path(relpath(page, path.parent)).as_posix(),
            "light": light(report)[0],
            "words": "; ".join(event_sentences(report)) or "nothing moves",
            "sessions": f"{report.sessions:,}",
            "last": day_text(report.last),
            "until": _until(report.recalibrate_before, report, bool(report.too_uncertain)),
        }
        for report, page in cells
    ]
    rows.sort(key=lambda row: (_ORDER.index(row["light"]), row["name"]))
    counts = {colour: sum(row["light"] == colour for row in rows) for colour in _ORDER}
    with whole_file(path) as file:
        file.write_text(render("plant.html.j2", rows=rows, sentence=_sentence(counts)), encoding="utf-8")


def _until(end: float | None, report: CellReport, too_uncertain: bool) -> str:
    """Return until when a calibration holds."""
    if too_uncertain:
        return "not known"
    if end is None:
        return "holds"
    return "over" if end <= report.last else day_text(end)


def _sentence(counts: dict[str, int]) -> str:
    total, told = sum(counts.values()), []
    if counts["bad"]:
        told.append(f"{counts['bad']} to recalibrate now")
    if counts["check"]:
        told.append(f"{counts['check']} in which something moves")
    return f"{total} cells: {', '.join(told)}." if told else f"{total} cells: nothing moves."
