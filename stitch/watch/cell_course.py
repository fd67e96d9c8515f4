"""The course of a cell as a page shows it: what its last sessions found, and where the parameters were."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.watch.catch_up import last_state, sessions_after, state_or_first, stored_alarms
from stitch.watch.cell_report import CellReport
from stitch.watch.history import History
from stitch.watch.smoother import smoothed_states

# Sessions that a page shows: a month of 20 a day.
MAX_SESSIONS = 600


@dataclass(frozen=True)
class CellTrend:
    """n sessions, P parameters of the report, in its units."""

    report: CellReport
    times: Array  # (n,) s since 1970
    values: Array  # (n, P) as the runs found them; NaN where one does not show a parameter
    sigmas: Array  # (n, P) as they state
    smoothed: Array  # (n, P)
    smoothed_sigmas: Array  # (n, P) with what all sessions have in common
    in_use: Array  # (P,) NaN where the calibration in use has no such parameter
    channels: dict[str, Array]  # (n,) NaN where a session does not tell


def cell_trend(history: History, report: CellReport, max_sessions: int = MAX_SESSIONS) -> CellTrend:
    """The last sessions of a cell, smoothed."""
    rows = history.sql("SELECT time FROM runs ORDER BY time DESC, id DESC LIMIT ?", max_sessions)
    kept, last = last_state(history, before=rows[-1][0]), last_state(history)
    assert last is not None
    sessions, moved = sessions_after(history, kept), defaultdict(list)
    for alarm in stored_alarms(history):
        moved[alarm.onset].append(alarm.parameter)
    seen = smoothed_states(state_or_first(history, kept), sessions, moved, last.state)
    part = slice(max(len(sessions.ids) - max_sessions, 0), None)
    common = np.array([p.common_sigma for p in report.parameters])
    times = dict(history.sql("SELECT id, time FROM runs"))
    return CellTrend(
        report=report,
        times=np.array([times[run] for run in sessions.ids[part]]),
        values=sessions.values[part],
        sigmas=sessions.sigmas[part],
        smoothed=seen.values[part],
        smoothed_sigmas=np.hypot(seen.own_sigmas[part], common),
        in_use=_in_use(history, len(report.parameters)),
        channels=_channels(history, list(sessions.ids[part])),
    )


def _in_use(history: History, parameters: int) -> Array:
    out = np.full(parameters, np.nan)
    found = history.sql(
        "SELECT parameter, value FROM estimates WHERE run = (SELECT id FROM runs WHERE run_hash = ?)",
        history.stated("in_use"),
    )
    for parameter, value in found:
        out[parameter - 1] = value
    return out


def _channels(history: History, runs: list[int]) -> dict[str, Array]:
    place = {run: k for k, run in enumerate(runs)}
    out = {name: np.full(len(runs), np.nan) for name in history.stated("channels")}
    for run, name, value in history.sql("SELECT run, name, value FROM covariates"):
        if run in place and name in out:
            out[name][place[run]] = value
    return out
