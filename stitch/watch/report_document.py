"""What a cell has to say, as JSON."""

from datetime import UTC, datetime
from typing import Any

from stitch.watch.cell_report import CellReport, ParameterReport
from stitch.watch.changes import Change
from stitch.watch.sentences import headline

REPORT_FORMAT = "stitch-watch/1"


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
        "name": p.name,
        "unit": p.unit,
        "value": p.value,
        "sigma": p.sigma,
        "common_sigma": p.common_sigma,
        "scatter": p.scatter,
        "drift_per_day": p.drift_per_day,
        "drift_sigma": p.drift_sigma,
        "process_noise": p.process_noise,
        "follows": [vars(f) for f in p.follows],
        "limit": p.limit,
        "valid_until": iso_time(p.valid_until),
        "alarm": None if p.alarm is None else _change_document(report, p.alarm),
        "changes": [_change_document(report, c) for c in p.changes],
    }


def _change_document(report: CellReport, c: Change) -> dict[str, Any]:
    return {
        "since": report.run_names[c.since],
        "since_time": iso_time(report.run_times[c.since]),
        "raised": report.run_names[c.raised],
        "kind": c.kind,
        "p_value": c.p_value,
        "channel": c.channel,
        "size": c.size,
        "size_sigma": c.sigma,
        "chart": c.chart,
    }
