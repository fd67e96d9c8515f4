"""A cell for other programs: its history as a Q-DAS file, its state as OpenMetrics text and as JSON."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from stitch.plugins.watch import dfq_file
from stitch.plugins.watch.history import History
from stitch.plugins.watch.report import CellReport, Change, ParameterReport, calibration_in_use, headline
from stitch.plugins.watch.update import sessions_from

_OF_PARAMETERS: tuple[tuple[str, str, Callable[[ParameterReport], float]], ...] = (
    ("stitch_parameter", "Smoothed value of a parameter, in the unit that its label names.", lambda p: p.value),
    ("stitch_parameter_sigma", "Standard deviation of the smoothed value.", lambda p: p.sigma),
    ("stitch_parameter_drift_per_day", "Slope of the smoothed value, per day.", lambda p: p.drift_per_day),
    ("stitch_parameter_alarm", "1 while an alarm stands, else 0.", lambda p: float(p.alarm is not None)),
    (
        "stitch_parameter_valid_until_seconds",
        "When the calibration in use may have left its limits, seconds since 1970; infinite beyond the horizon.",
        lambda p: np.inf if p.valid_until is None else p.valid_until,
    ),
)
_OF_CELLS: tuple[tuple[str, str, Callable[[CellReport], float]], ...] = (
    ("stitch_cell_sessions", "Sessions in the history of a cell.", lambda r: float(r.sessions)),
    ("stitch_cell_last_session_seconds", "Time of the last session, seconds since 1970.", lambda r: r.last),
)
REPORT_FORMAT = "stitch-watch/1"
# Keys that are called as the fields that they hold.
_KEYS_OF_PARAMETERS: tuple[str, ...] = (
    *("name", "unit", "value", "sigma", "common_sigma", "scatter", "drift_per_day", "drift_sigma"),
    *("process_noise", "limit"),
)


def dfq_text(history: History, report: CellReport) -> str:
    """All sessions of a cell as the text of a DFQ file; nominal is the calibration in use."""
    rows = history.sql("SELECT id, time FROM runs ORDER BY time, id")
    sessions = sessions_from(history, [run for run, _ in rows])
    in_use = calibration_in_use(history, len(report.parameters))
    characteristics = [
        dfq_file.Characteristic(p.name, p.unit, middle, middle - p.limit, middle + p.limit)
        if np.isfinite(middle) and np.isfinite(p.limit)
        else dfq_file.Characteristic(p.name, p.unit)
        for p, middle in zip(report.parameters, in_use, strict=True)
    ]
    times = [time for _, time in rows]
    return dfq_file.dfq_text(report.name, characteristics, zip(times, sessions.values, strict=True))


def openmetrics(reports: Sequence[CellReport]) -> str:
    """OpenMetrics 1.0 text of some cells; the formats of Prometheus read it as well."""
    lines = list[str]()
    for name, meaning, of_parameter in _OF_PARAMETERS:
        lines += _head(name, meaning)
        for report in reports:
            for p in report.parameters:
                labels = _labels(cell=report.name, parameter=p.name, unit=p.unit)
                lines.append(f"{name}{labels} {_number(of_parameter(p))}")
    for name, meaning, of_cell in _OF_CELLS:
        lines += _head(name, meaning)
        lines += [f"{name}{_labels(cell=report.name)} {_number(of_cell(report))}" for report in reports]
    return "\n".join([*lines, "# EOF", ""])


def _head(name: str, meaning: str) -> list[str]:
    return [f"# TYPE {name} gauge", f"# HELP {name} {meaning}"]


def _labels(**labels: str) -> str:
    safe = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})
    return "{" + ",".join(f'{name}="{text.translate(safe)}"' for name, text in labels.items()) + "}"


def _number(value: float) -> str:
    if np.isnan(value):
        return "NaN"
    return repr(float(value)) if np.isfinite(value) else ("+Inf" if value > 0 else "-Inf")


def report_document(report: CellReport) -> dict[str, Any]:
    """A cell report as plain data; times in ISO 8601, UTC."""
    return {
        "format": REPORT_FORMAT,
        "cell": report.name,
        "sentence": headline(report),
        "length_unit": report.length_unit,
        "sessions": report.sessions,
        "first": iso_time(report.first),
        "last": iso_time(report.last),
        "in_use": report.in_use,
        "recalibrate_before": iso_time(report.recalibrate_before),
        "sessions_to_a_false_alarm": report.run_length,
        "parameters": [_parameter_document(report, p) for p in report.parameters],
    }


def iso_time(time: float | None) -> str | None:
    """Seconds since 1970 as ISO 8601."""
    return None if time is None else datetime.fromtimestamp(time, UTC).isoformat(timespec="seconds")


def _parameter_document(report: CellReport, p: ParameterReport) -> dict[str, Any]:
    return {
        **{key: getattr(p, key) for key in _KEYS_OF_PARAMETERS},
        "follows": [vars(f) for f in p.follows],
        "valid_until": iso_time(p.valid_until),
        "alarm": None if p.alarm is None else _change_document(report, p.alarm),
        "changes": [_change_document(report, c) for c in p.changes],
    }


def _change_document(report: CellReport, c: Change) -> dict[str, Any]:
    return {
        "since": report.run_names[c.since],
        "since_time": iso_time(report.run_times[c.since]),
        "raised": report.run_names[c.raised],
        **{key: getattr(c, key) for key in ("kind", "p_value", "channel", "size", "chart")},
        "size_sigma": c.sigma,
    }
