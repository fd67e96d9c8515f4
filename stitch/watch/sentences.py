"""What moves in a cell, in one sentence an event."""

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from stitch.units import display_unit, length_text
from stitch.watch.cell_report import CellReport, ParameterReport
from stitch.watch.changes import Change

# Steps of several parameters that begin within so many seconds are one event.
_TOGETHER = 24 * 3600.0
# Sessions that scatter by more than so many stated sigmas are remarked.
_WIDE = 2.0
_PLACES = {"hand_eye": "the mount"}
_Alarmed = tuple[ParameterReport, Change]


def headline(report: CellReport) -> str:
    """The verdict on a cell in one line."""
    told = event_sentences(report)
    if not told:
        return f"{report.name}: nothing moves in {report.sessions:,} sessions; {_recalibration_note(report)}."
    return f"{report.name}: {'; '.join(told)}; {_recalibration_note(report)}."


def event_sentences(report: CellReport) -> list[str]:
    """One for every event that stands, in the order of their onsets."""
    left, groups = sorted(report.alarms, key=lambda item: _significance_rank(item[1])), list[list[_Alarmed]]()
    while left:
        # Small steps are dated by the large one beside them.
        groups.append([item for item in left if _is_same_event(report, left[0], item)])
        left = [item for item in left if item not in groups[-1]]
    return [
        _event_sentence(report, group)
        for group in sorted(groups, key=lambda group: report.run_times[group[0][1].since])
    ]


def report_notes(report: CellReport) -> list[str]:
    """What to know before trusting the verdict."""
    wide = [p for p in report.parameters if p.scatter > _WIDE]
    if not wide:
        return []
    worst = max(wide, key=lambda p: p.scatter)
    return [
        f"Sessions scatter up to {worst.scatter:.1f} times as much as their runs state ({worst.name}): something "
        "changes from session to session that the model does not know, or the runs' sigmas are too small."
    ]


def size_text(value: float, unit: str, sigma: float | None = None) -> str:
    """A value with its unit for people: lengths in µm or mm, the rest as everywhere."""
    told = value if sigma is None or not np.isfinite(sigma) else float(f"{value:.{_digits(value, sigma)}g}")
    if unit in ("mm", "m"):
        return length_text(told, unit)
    factor, name = display_unit(unit)
    return f"{factor * told:.4g} {name}"


def day_text(time: float | None) -> str:
    """A time (s since 1970, UTC) for people."""
    return "–" if time is None else datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M")


def _digits(value: float, sigma: float) -> int:
    if not value or sigma <= 0:
        return 3
    return int(np.clip(np.floor(np.log10(abs(value))) - np.floor(np.log10(sigma)) + 2, 1, 6))


def _significance_rank(change: Change) -> tuple[float, float]:
    """The clearest first; beyond the smallest number that there is, by size in sigmas."""
    return (change.p_value if np.isfinite(change.p_value) else 1.0, -abs(change.size) / max(change.sigma, 1e-300))


def _is_same_event(report: CellReport, clearest: _Alarmed, other: _Alarmed) -> bool:
    (p, a), (q, b) = clearest, other
    near = abs(report.run_times[a.since] - report.run_times[b.since]) <= _TOGETHER
    return p.name == q.name or (near and a.kind == b.kind == "step" and _effect_name(p) == _effect_name(q))


def _effect_name(parameter: ParameterReport) -> str:
    return parameter.name.partition(".")[0]


def _event_sentence(report: CellReport, group: Sequence[_Alarmed]) -> str:
    clearest = group[0][1]
    since = f"{report.run_names[clearest.since]} ({day_text(report.run_times[clearest.since])})"
    effect = _effect_name(group[0][0])
    if clearest.kind == "step":
        sizes = ", ".join(f"{p.name.partition('.')[2]} {size_text(c.size, p.unit, c.sigma)}" for p, c in group)
        return f"{_PLACES.get(effect, effect)} jumped before session {since}: {sizes}"
    parameter, change = group[0]
    if change.channel is not None:
        per = size_text(change.size, parameter.unit, change.sigma)
        return f"{parameter.name} follows {change.channel} since session {since}, {per} per unit"
    per_day = size_text(change.size, parameter.unit, change.sigma)
    share = change.size / parameter.in_use if parameter.in_use and effect != "hand_eye" else float("nan")
    rate = f"{100 * share:+.2g} % a day" if np.isfinite(share) else f"{per_day} a day"
    return f"{parameter.name} drifts since session {since}, {rate}"


def _recalibration_note(report: CellReport) -> str:
    end = report.recalibrate_before
    if end is None:
        return "the calibration in use holds"
    return (
        "the calibration in use does not hold: recalibrate now"
        if end <= report.last
        else f"recalibrate before {day_text(end)}"
    )
