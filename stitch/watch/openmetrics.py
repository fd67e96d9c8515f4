"""Cells as OpenMetrics text: for the text file collector of a Prometheus node exporter, or any scraper."""

from collections.abc import Callable, Sequence

import numpy as np

from stitch.watch.cell_report import CellReport, ParameterReport

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
    return "{" + ",".join(f'{name}="{_escaped(text)}"' for name, text in labels.items()) + "}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _number(value: float) -> str:
    if np.isnan(value):
        return "NaN"
    return repr(float(value)) if np.isfinite(value) else ("+Inf" if value > 0 else "-Inf")
