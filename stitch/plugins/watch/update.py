"""A run joins the history of its cell: stored, then followed from the last state on.

Where nothing moves, a parameter may follow the channels, how fast temperatures change, and the hour. Arms and mounts
lag behind the air by hours: a temperature and its lag together span every delayed response, whatever the weather does
to the swing of the day; the hour spans what nobody has a thermometer for.
"""

import hashlib
import io
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.plugins.watch.control_charts import Charts
from stitch.plugins.watch.history import (
    TWIST_NAMES,
    History,
    insert_run,
    matrix_json,
    mount_twist,
    scanned_middle,
    twist_covariance,
)
from stitch.plugins.watch.run_record import Estimate, RunRecord
from stitch.plugins.watch.state_bank import Bank
from stitch.plugins.watch.tracking import (
    Alarm,
    CellState,
    Sessions,
    alarming_parameters,
    first_state,
    next_state,
    raise_alarm,
)

DAY_SECONDS = 86400.0
# Every channel costs sessions until its share is known.
_MOST_CHANNELS = 4
# Time over which a temperature is averaged for its lag, s; after so many of them an older session counts nothing.
_LAG = 3 * 3600.0
_LOOK_BACK = 16 * _LAG
# How far, in sigmas, a parameter may follow a degree, or the hour; of other channels nothing is believed.
_BELIEVED = 10.0
_HOURS = 2
# So many rows are asked for by their numbers; of more the table is read.
_MANY = 2000
# A state is kept at every so many sessions, the last few hundred sessions long, and beyond at longer intervals.
_STEP, _FAR_STEP = 32, 512
# Sessions that an onset is sought in, and over which states are kept at short intervals.
_RECENT = 640
# One false alarm of the whole cell in so many sessions where nothing happens: two hundred months of 600, so that one in
# a hundred remains where parameters follow temperatures in ways that the regressors do not quite have.
RUN_LENGTH = 120_000.0
# By what a cell is known again: names of arm and scanner, and the arm's DH rows. A calibrated arm differs from its data
# sheet by less than this (mm, degrees); another arm by more in some row.
_DH_ROW = ("a", "alpha_deg", "d", "theta_deg")
_ARM_LENGTH, _ARM_ANGLE = 10.0, 2.0


def chosen_channels(covariates: Iterable[str]) -> list[str]:
    """Covariates that parameters may follow: temperatures first, four at most."""
    return sorted(covariates, key=lambda name: ("temperature" not in name, name))[:_MOST_CHANNELS]


def regressor_prior_sigmas(channels: Sequence[str]) -> Array:
    """(c,) how far, in sigmas, a parameter may follow each regressor by one unit; inf: anything."""
    of_channels = [_BELIEVED if _is_temperature(name) else np.inf for name in channels]
    return np.array(of_channels + [_BELIEVED] * (sum(map(_is_temperature, channels)) + _HOURS))


def regressors(times: Array, channels: Array, names: Sequence[str]) -> Array:
    """(n, c) the channels, temperatures less their lag, sine and cosine of the hour.

    Args:
        times: (n,) in order, s since 1970.
        channels: (n, len(names)) less their references; NaN where a session does not tell, which counts as the last
            that did.
    """
    rows = np.arange(len(times))[:, None]
    last_known = np.maximum.accumulate(np.where(np.isfinite(channels), rows, -1), axis=0)
    filled = np.take_along_axis(channels, np.maximum(last_known, 0), axis=0)
    known = np.where(last_known >= 0, filled, 0.0)
    warm = [c for c, name in enumerate(names) if _is_temperature(name)]
    rates = known[:, warm] - _lagged_means(times, known[:, warm])
    angle = 2 * np.pi * times / DAY_SECONDS
    return np.column_stack([known, rates, np.sin(angle), np.cos(angle)])


def _is_temperature(channel: str) -> bool:
    return channel.endswith("temperature_c")


def _lagged_means(times: Array, values: Array) -> Array:
    """(n, c) mean of the sessions so far, weighed by exp(−age/lag)."""
    total, weight, out = np.zeros(values.shape[1]), 0.0, np.zeros_like(values)
    fade = np.exp(-np.diff(times, prepend=times[:1]) / _LAG)
    for k, value in enumerate(values):
        total, weight = total * fade[k] + value, weight * fade[k] + 1.0
        out[k] = total / weight
    return out


def stored_parameters(history: History) -> list[tuple[str, str]]:
    """Name and unit of all parameters, in the order in which they came."""
    return history.sql("SELECT name, unit FROM parameters ORDER BY id")


def sessions_from(history: History, ids: Sequence[int]) -> Sessions:
    """Sessions by their numbers."""
    parameters = stored_parameters(history)
    channels = history.stated("channels") or []
    if len(ids) > _MANY:
        wanted = set(ids)
        rows = [row for row in history.sql("SELECT id, time FROM runs ORDER BY time, id") if row[0] in wanted]
    else:
        marks = ", ".join("?" * len(ids))
        rows = history.sql(f"SELECT id, time FROM runs WHERE id IN ({marks}) ORDER BY time, id", *ids)
    place = {run: k for k, (run, _) in enumerate(rows)}
    times = np.array([time for _, time in rows], float)
    values = np.full((len(rows), len(parameters)), np.nan)
    sigmas = values.copy()
    for run, parameter, value, sigma in _rows_of_runs(history, "estimates", list(place)):
        values[place[run], parameter - 1] = value
        sigmas[place[run], parameter - 1] = sigma
    return Sessions(
        ids=list(place),
        days=(times - float(history.stated("first_time") or 0.0)) / DAY_SECONDS,
        values=values,
        sigmas=sigmas,
        covariates=_regressors_of(history, channels, rows),
        prior_sigmas=regressor_prior_sigmas(channels),
        channels=channels,
    )


def _regressors_of(history: History, names: Sequence[str], rows: Sequence[tuple[int, float]]) -> Array:
    """(n, c) of some sessions; those before them tell what a temperature lags behind."""
    if not rows:
        return np.zeros((0, len(regressor_prior_sigmas(names))))
    span = (rows[0][1] - _LOOK_BACK, rows[-1][1])
    around = history.sql("SELECT id, time FROM runs WHERE time BETWEEN ? AND ? ORDER BY time, id", *span)
    place = {run: k for k, (run, _) in enumerate(around)}
    reference = history.stated("channel_references") or {}
    channels = np.full((len(around), len(names)), np.nan)
    for run, name, value in _rows_of_runs(history, "covariates", list(place)):
        if name in names:
            channels[place[run], names.index(name)] = value - reference[name]
    times = np.array([time for _, time in around], float)
    return regressors(times, channels, names)[[place[run] for run, _ in rows]]


def _rows_of_runs(history: History, table: str, runs: Sequence[int]) -> list[tuple[Any, ...]]:
    if len(runs) > _MANY:
        known = set(runs)
        return [row for row in history.sql(f"SELECT * FROM {table}") if row[0] in known]
    return history.sql(f"SELECT * FROM {table} WHERE run IN ({', '.join('?' * len(runs))})", *runs)


def last_state(history: History, before: float = np.inf) -> CellState:
    """The last state that is kept before a time (s since 1970); without one, that before the first session."""
    rows = history.sql(
        "SELECT run, time, number, data FROM states WHERE time < ? ORDER BY time DESC, run DESC LIMIT 1",
        min(before, 1e300),
    )
    if not rows:
        return first_state(len(regressor_prior_sigmas(history.stated("channels") or [])))
    run, time, number, data = rows[0]
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        bank = Bank(**{field.name: stored[field.name] for field in fields(Bank)})
        charts = Charts(**{field.name: stored[field.name] for field in fields(Charts)})
        return CellState(bank, charts, float(stored["day"]), run, time, number)


def sessions_after(history: History, state: CellState) -> Sessions:
    """The sessions after a state."""
    rows = history.sql("SELECT id FROM runs WHERE (time, id) > (?, ?) ORDER BY time, id", state.time, state.run)
    return sessions_from(history, [run for (run,) in rows])


def stored_alarms(history: History) -> list[Alarm]:
    """All alarms, in the order in which they were raised; parameters count from 0."""
    return [Alarm(p - 1, *rest) for p, *rest in history.sql("SELECT parameter, onset, raised, chart FROM alarms")]


def append_runs(history: History, records: Sequence[RunRecord]) -> int:
    """Append runs in the order of time, all or none; those that are there already change nothing. How many were new.

    Raises:
        InputError: a run of another cell, or one that repeats the numbers of another session.
    """
    with history.writing():
        stored = [_store_run(history, record) for record in sorted(records, key=lambda r: r.time)]
        new = [time for time in stored if time is not None]
        if new:
            _follow_since(history, min(new))
        return len(new)


def _follow_since(history: History, time: float) -> None:
    """Follow all sessions from a time on (s since 1970), and what comes after them.

    An alarm with an onset in the past is followed anew from there; each has its onset after the one before, so that
    this ends.
    """
    _forget_since(history, time)
    while (onset := _follow_remaining(history)) is not None:
        _forget_states(history, onset)


def _forget_since(history: History, time: float) -> None:
    """Drop what was concluded at a time or later: states, and alarms that were raised."""
    _forget_states(history, time)
    history.sql("DELETE FROM alarms WHERE raised IN (SELECT id FROM runs WHERE time >= ?)", max(time, -1e300))


def _forget_states(history: History, time: float) -> None:
    """Drop the states of a time (s since 1970) or later."""
    history.sql("DELETE FROM states WHERE time >= ?", max(time, -1e300))


def _follow_remaining(history: History) -> float | None:
    """Follow what is not followed yet; the time of the earliest onset as soon as something alarms."""
    state = last_state(history)
    alarms = stored_alarms(history)
    sessions = sessions_after(history, state)
    run_length = float(history.stated("run_length"))
    times = dict(history.sql("SELECT id, time FROM runs WHERE time >= ?", state.time))
    for k, run in enumerate(sessions.ids):
        followed = next_state(state, sessions, k, [a.parameter for a in alarms if a.onset == run])
        state = replace(followed, run=run, time=times[run], number=state.number + 1)
        if k == len(sessions.ids) - 1 or state.number % _STEP == 0:
            _store_state(history, state)
        if alarming := alarming_parameters(state, run_length):
            recent = history.sql(
                "SELECT id FROM runs WHERE (time, id) <= (?, ?) ORDER BY time DESC, id DESC LIMIT ?",
                *(state.time, run, _RECENT),
            )
            recent_sessions = sessions_from(history, [run for (run,) in recent])
            at = list(recent_sessions.ids).index(run)
            new = [raise_alarm(recent_sessions, at, parameter, chart, alarms) for parameter, chart in alarming]
            history.many(
                "INSERT INTO alarms (parameter, onset, raised, chart) VALUES (?, ?, ?, ?)",
                [(a.parameter + 1, a.onset, a.raised, a.chart) for a in new],
            )
            return min(float(history.sql("SELECT time FROM runs WHERE id = ?", a.onset)[0][0]) for a in new)
    return None


def _store_state(history: History, state: CellState) -> None:
    """Keep a state; the one before goes unless its number is one at which states are kept."""
    buffer = io.BytesIO()
    np.savez(buffer, **vars(state.bank), **vars(state.charts), day=np.array(state.day))
    history.sql("DELETE FROM states WHERE number % ? != 0 AND number < ?", _STEP, state.number)
    history.sql("DELETE FROM states WHERE number % ? != 0 AND number < ?", _FAR_STEP, state.number - _RECENT)
    row = (state.run, state.time, state.number, buffer.getvalue())
    history.sql("INSERT OR REPLACE INTO states VALUES (?, ?, ?, ?)", *row)


def _store_run(history: History, record: RunRecord) -> float | None:
    """Store a run; the time from which the history has to be followed anew, None where the run is there already."""
    if history.sql("SELECT 1 FROM runs WHERE run_hash = ?", record.run_hash):
        return None
    if history.stated("length_unit") is None:
        _begin_cell(history, record)
    for key, value in (("length_unit", record.length_unit), ("mount", record.mount)):
        if (stated := history.stated(key)) != value:
            raise InputError(
                f"{record.path}: has {key} {value}, the cell {history.folder} {stated}; to fix: name the cell of this "
                "run"
            )
    identity = cell_identity(Path(record.session))
    known = history.stated("identity") or {}
    if (other := other_cell(known, identity, record.length_unit)) is not None:
        raise InputError(f"{record.path}: {other}; to fix: name the cell of this run, or begin a new one")
    history.state({"identity": identity | known})
    begun = min(record.time, _replace_former_run(history, record))
    values = repr([(e.name, e.value) for e in record.estimates])
    numbers = matrix_json(record.T_mount) + matrix_json(record.covariance) + values
    numbers_hash = hashlib.sha256(numbers.encode()).hexdigest()
    for (other,) in history.sql("SELECT run FROM runs WHERE numbers_hash = ?", numbers_hash):
        raise InputError(
            f"{record.path}: has the very numbers of {other}: one fit, not two; to fix: run its session for itself"
        )
    run = insert_run(history, record, numbers_hash)
    estimates = [*_hand_eye_estimates(history, record), *record.estimates]
    _insert_parameters(history, record, estimates)
    ids = dict(history.sql("SELECT name, id FROM parameters"))
    rows = [(run, ids[e.name], e.value, e.sigma) for e in estimates if np.isfinite(e.sigma) and e.sigma > 0]
    if not rows:
        raise InputError(f"{record.path}: states no sigma of anything; to fix: run its session again")
    history.many("INSERT INTO estimates VALUES (?, ?, ?, ?)", rows)
    history.many("INSERT INTO covariates VALUES (?, ?, ?)", [(run, *item) for item in record.covariates.items()])
    if _update_channels(history, record):
        return -np.inf
    return begun


def cell_identity(session: Path) -> dict[str, Any]:
    """Return what session.toml states of arm and scanner; {} where there is none, or where it states nothing."""
    try:
        document = tomllib.loads((session / "session.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    robot, scanner = document.get("robot", {}), document.get("scanner", {})
    rows = [[float(joint.get(key, 0.0)) for key in _DH_ROW] for joint in robot.get("joints", [])]
    stated = {"arm": robot.get("name"), "scanner": scanner.get("name"), "rows": rows}
    return {key: value for key, value in stated.items() if value}


def other_cell(known: dict[str, Any], told: dict[str, Any], length_unit: str) -> str | None:
    """Return by what a session is of another cell, in words; None where both could be one."""
    for key in ("arm", "scanner"):
        if key in known and key in told and known[key] != told[key]:
            return f"has {key} {told[key]}, the cell {known[key]}"
    if "rows" in known and "rows" in told:
        if len(known["rows"]) != len(told["rows"]):
            return f"has an arm of {len(told['rows'])} joints, the cell one of {len(known['rows'])}"
        in_mm = METRES.get(length_unit, 1e-3) * 1e3
        limits = np.array([_ARM_LENGTH / in_mm, _ARM_ANGLE, _ARM_LENGTH / in_mm, _ARM_ANGLE])
        off = np.abs(np.array(told["rows"]) - np.array(known["rows"])) / limits
        if off.max() > 1:
            return f"has other DH rows than the cell (joint {int(off.max(axis=1).argmax()) + 1} first of all)"
    return None


def _begin_cell(history: History, record: RunRecord) -> None:
    """What the first run fixes for good: units, the mount's place, the point about which it is watched."""
    centre, radius = scanned_middle(record)
    history.state(
        {
            "length_unit": record.length_unit,
            "mount": record.mount,
            "hand_eye_first": record.T_mount.tolist(),
            "centre_scanner": centre.tolist(),
            "radius": radius,
            "first_time": record.time,
            "run_length": RUN_LENGTH,
            "channels": [],
            "channel_references": {},
            "in_use": record.run_hash,
        }
    )


def _replace_former_run(history: History, record: RunRecord) -> float:
    """A session that was run again counts once, as it was run last; the time of the former run, inf without."""
    begun = np.inf
    for run, time, run_hash in history.sql(
        "SELECT id, time, run_hash FROM runs WHERE session_hash = ?", record.session_hash
    ):
        begun = min(begun, float(time))
        _forget_since(history, time)
        for table, key in (("runs", "id"), ("estimates", "run"), ("covariates", "run")):
            history.sql(f"DELETE FROM {table} WHERE {key} = ?", run)
        if history.stated("in_use") == run_hash:
            history.state({"in_use": record.run_hash})
    return begun


def _hand_eye_estimates(history: History, record: RunRecord) -> list[Estimate]:
    first = np.array(history.stated("hand_eye_first"))
    centre = np.array(history.stated("centre_scanner"))
    values = mount_twist(record.T_mount, first, centre)
    sigmas = np.sqrt(np.maximum(np.diag(twist_covariance(record.covariance, record.T_mount, first, centre)), 0.0))
    units = ["rad"] * 3 + [record.length_unit] * 3
    rows = zip(TWIST_NAMES, units, values, sigmas, strict=True)
    return [Estimate(f"hand_eye.{name}", unit, float(value), float(sigma)) for name, unit, value, sigma in rows]


def _insert_parameters(history: History, record: RunRecord, estimates: Sequence[Estimate]) -> None:
    units = dict(history.sql("SELECT name, unit FROM parameters"))
    for estimate in estimates:
        if estimate.name not in units:
            history.sql("INSERT INTO parameters (name, unit) VALUES (?, ?)", estimate.name, estimate.unit)
        elif units[estimate.name] != estimate.unit:
            raise InputError(
                f"{record.path}: counts {estimate.name} in {estimate.unit}, the cell in {units[estimate.name]}; "
                "to fix: name the cell of this run"
            )


def _update_channels(history: History, record: RunRecord) -> bool:
    """Whether what parameters may follow is another now: then all is followed anew."""
    before = history.stated("channels")
    references = history.stated("channel_references")
    if record.covariates.keys() <= references.keys():
        return False
    references = record.covariates | references
    channels = chosen_channels(references)
    history.state({"channels": channels, "channel_references": references})
    return bool(before != channels)
