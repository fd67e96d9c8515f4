"""When a session was measured, and under which conditions: the means of its covariates."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.reading.csv_lines import read_csv_lines
from stitch.reading.csv_number import is_number
from stitch.reading.views_csv import covariate_names

# A time_s beyond counts seconds since 1970 (this is 2001); below, since the session began.
_EPOCH = 1e9


@dataclass(frozen=True)
class SessionConditions:
    """Of one session."""

    time: float  # s since 1970, UTC
    time_from: str
    covariates: dict[str, float]  # means over the views


def session_conditions(session: Path, result: Path) -> SessionConditions:
    """What views.csv says; where it has gone, the time of a run's result.json.

    Raises:
        InputError: views.csv is no table.
    """
    file = session / "views.csv"
    if not file.is_file():
        return SessionConditions(result.stat().st_mtime, "file time of result.json", {})
    header, lines = read_csv_lines(file)
    rows = [(line, dict(zip(header, cells, strict=True))) for line, cells in lines]
    if not rows:
        raise InputError(f"{file}: no views; write one row per scan")
    names = [*covariate_names(header, rows), *(["time_s"] if "time_s" in header else [])]
    columns = {name: _column_numbers([row[name] for _, row in rows]) for name in names}
    times = columns.pop("time_s", [])
    covariates = {name: float(np.mean(numbers)) for name, numbers in columns.items() if numbers}
    if times and min(times) > _EPOCH:
        return SessionConditions(float(np.mean(times)), "time_s of views.csv", covariates)
    return SessionConditions(file.stat().st_mtime, "file time of views.csv", covariates)


def _column_numbers(cells: list[str]) -> list[float]:
    numbers = [float(cell) for cell in cells if is_number(cell)]
    return [x for x in numbers if np.isfinite(x)]
