"""The states of a history brought up to its last session; one that comes late is followed from its time on."""

import io
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from stitch.watch.control_charts import Charts
from stitch.watch.follow import Alarm, CellState, Sessions, alarming_parameters, first_state, next_state, raise_alarm
from stitch.watch.history import History
from stitch.watch.regressors import regressor_prior_sigmas
from stitch.watch.state_bank import Bank
from stitch.watch.stored_sessions import session_columns, sessions_from

# A state is kept at every so many sessions, the last few hundred sessions long, and beyond at longer intervals.
_STEP, _FAR, _LATE = 32, 512, 640


def catch_up(history: History, since: float) -> None:
    """Follow all sessions from a time on (s since 1970), and what comes after them.

    An alarm with an onset in the past is followed anew from there; each has its onset after the one before, so that
    this ends.
    """
    forget_since(history, since)
    while (onset := _follow_remaining(history)) is not None:
        forget_states(history, onset)


def forget_since(history: History, time: float) -> None:
    """Drop what was concluded at a time or later: states, and alarms that were raised."""
    forget_states(history, time)
    history.sql("DELETE FROM alarms WHERE raised IN (SELECT id FROM runs WHERE time >= ?)", max(time, -1e300))


def forget_states(history: History, time: float) -> None:
    """Drop the states of a time (s since 1970) or later."""
    history.sql("DELETE FROM states WHERE time >= ?", max(time, -1e300))


@dataclass(frozen=True)
class StoredState:
    """A state that is kept."""

    run: int
    time: float
    number: int  # of sessions so far
    state: CellState


def last_state(history: History, before: float = np.inf) -> StoredState | None:
    """The last state that is kept before a time (s since 1970)."""
    rows = history.sql(
        "SELECT run, time, number, data FROM states WHERE time < ? ORDER BY time DESC, run DESC LIMIT 1",
        min(before, 1e300),
    )
    if not rows:
        return None
    run, time, number, data = rows[0]
    return StoredState(run, time, number, _unpack_state(data))


def sessions_after(history: History, kept: StoredState | None) -> Sessions:
    """The sessions after a state; all of them without one."""
    time, run = (kept.time, kept.run) if kept else (-1e300, -1)
    rows = history.sql("SELECT id FROM runs WHERE (time, id) > (?, ?) ORDER BY time, id", time, run)
    return sessions_from(history, [run for (run,) in rows])


def state_or_first(history: History, kept: StoredState | None) -> CellState:
    """The state itself, or that before the first session."""
    return kept.state if kept else first_state(len(regressor_prior_sigmas(session_columns(history).channels)))


def stored_alarms(history: History) -> list[Alarm]:
    """All alarms, in the order in which they were raised; parameters count from 0."""
    return [Alarm(p - 1, *rest) for p, *rest in history.sql("SELECT parameter, onset, raised, chart FROM alarms")]


def _follow_remaining(history: History) -> float | None:
    """Follow what is not followed yet; the time of the earliest onset as soon as something alarms."""
    kept, run_length, alarms = last_state(history), float(history.stated("run_length")), stored_alarms(history)
    state, number, sessions = state_or_first(history, kept), kept.number if kept else 0, sessions_after(history, kept)
    times = dict(history.sql("SELECT id, time FROM runs WHERE time >= ?", kept.time if kept else -1e300))
    for k, run in enumerate(sessions.ids):
        state = next_state(state, sessions, k, [a.parameter for a in alarms if a.onset == run])
        number += 1
        _store_state(history, run, times[run], number, state, last=k == len(sessions.ids) - 1)
        if found := alarming_parameters(state, run_length):
            new = [_store_alarm(history, run, parameter, chart, alarms) for parameter, chart in found]
            history.many(
                "INSERT INTO alarms (parameter, onset, raised, chart) VALUES (?, ?, ?, ?)",
                [(a.parameter + 1, a.onset, a.raised, a.chart) for a in new],
            )
            return min(float(history.sql("SELECT time FROM runs WHERE id = ?", a.onset)[0][0]) for a in new)
    return None


def _store_alarm(history: History, run: int, parameter: int, chart: str, before: list[Alarm]) -> Alarm:
    sessions = recent_sessions(history, run)
    return raise_alarm(sessions, list(sessions.ids).index(run), parameter, chart, before)


def recent_sessions(history: History, run: int, most: int = 640) -> Sessions:
    """The sessions up to one, `most` at most."""
    rows = history.sql(
        "SELECT id FROM runs WHERE (time, id) <= (SELECT time, id FROM runs WHERE id = ?) "
        "ORDER BY time DESC, id DESC LIMIT ?",
        run,
        most,
    )
    ids = [row[0] for row in rows]
    return sessions_from(history, ids)


def _store_state(history: History, run: int, time: float, number: int, state: CellState, last: bool) -> None:
    """Keep a state where one is wanted; the one before goes unless it is."""
    if last or number % _STEP == 0:
        history.sql("DELETE FROM states WHERE number % ? != 0 AND number < ?", _STEP, number)
        history.sql("DELETE FROM states WHERE number % ? != 0 AND number < ?", _FAR, number - _LATE)
        history.sql("INSERT OR REPLACE INTO states VALUES (?, ?, ?, ?)", run, time, number, _pack_state(state))


def _pack_state(state: CellState) -> bytes:
    buffer = io.BytesIO()
    arrays: dict[str, Any] = state.bank.arrays() | state.charts.arrays() | {"day": np.array(state.day)}
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _unpack_state(data: bytes) -> CellState:
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        bank = Bank(**{field.name: stored[field.name] for field in fields(Bank)})
        charts = Charts(**{field.name: stored[field.name] for field in fields(Charts)})
        return CellState(bank, charts, float(stored["day"]))
