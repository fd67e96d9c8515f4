"""The sessions of a history as arrays, in the order of time."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stitch.frames import Array
from stitch.watch.follow import Sessions
from stitch.watch.history import History
from stitch.watch.regressors import DAY_SECONDS, LOOK_BACK, regressor_prior_sigmas, regressors

# So many rows are asked for by their numbers; of more the table is read.
_MANY = 2000


@dataclass(frozen=True)
class SessionColumns:
    """What the columns of `Sessions` are."""

    parameters: Sequence[str]
    units: Sequence[str]
    channels: Sequence[str]
    first: float  # time of the first session, s since 1970


def session_columns(history: History) -> SessionColumns:
    """Parameters in the order in which they came, channels as `chosen_channels` says."""
    parameters = history.sql("SELECT name, unit FROM parameters ORDER BY id")
    return SessionColumns(
        parameters=[name for name, _ in parameters],
        units=[unit for _, unit in parameters],
        channels=history.stated("channels") or [],
        first=float(history.stated("first_time") or 0.0),
    )


def sessions_from(history: History, ids: Sequence[int]) -> Sessions:
    """Sessions by their numbers."""
    names, wanted = session_columns(history), set(ids)
    if len(ids) > _MANY:
        rows = [row for row in history.sql("SELECT id, time FROM runs ORDER BY time, id") if row[0] in wanted]
    else:
        marks = ", ".join("?" * len(ids))
        rows = history.sql(f"SELECT id, time FROM runs WHERE id IN ({marks}) ORDER BY time, id", *ids)
    place = {run: k for k, (run, _) in enumerate(rows)}
    times = np.array([time for _, time in rows], float)
    values = np.full((len(rows), len(names.parameters)), np.nan)
    sigmas = values.copy()
    for run, parameter, value, sigma in _rows_of_runs(history, "estimates", list(place)):
        values[place[run], parameter - 1], sigmas[place[run], parameter - 1] = value, sigma
    return Sessions(
        ids=list(place),
        days=(times - names.first) / DAY_SECONDS,
        values=values,
        sigmas=sigmas,
        covariates=_regressors(history, names, rows),
        prior_sigmas=regressor_prior_sigmas(names.channels),
        channels=names.channels,
    )


def _regressors(history: History, names: SessionColumns, rows: Sequence[tuple[int, float]]) -> Array:
    """(n, c) of some sessions; those before them tell what a temperature lags behind."""
    if not rows:
        return np.zeros((0, len(regressor_prior_sigmas(names.channels))))
    span = (rows[0][1] - LOOK_BACK, rows[-1][1])
    around = history.sql("SELECT id, time FROM runs WHERE time BETWEEN ? AND ? ORDER BY time, id", *span)
    place = {run: k for k, (run, _) in enumerate(around)}
    reference = history.stated("channel_references") or {}
    channels = np.full((len(around), len(names.channels)), np.nan)
    column = {name: c for c, name in enumerate(names.channels)}
    for run, name, value in _rows_of_runs(history, "covariates", list(place)):
        if name in column:
            channels[place[run], column[name]] = value - reference[name]
    found = regressors(np.array([time for _, time in around], float), channels, names.channels)
    return found[[place[run] for run, _ in rows]]


def _rows_of_runs(history: History, table: str, runs: Sequence[int]) -> list[tuple[Any, ...]]:
    """Rows of a table that belong to some runs."""
    if len(runs) > _MANY:
        known = set(runs)
        return [row for row in history.sql(f"SELECT * FROM {table}") if row[0] in known]
    return history.sql(f"SELECT * FROM {table} WHERE run IN ({', '.join('?' * len(runs))})", *runs)
