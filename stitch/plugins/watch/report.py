"""What a cell has to say, as plain data: where its parameters are, what moves, until when the calibration holds."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from scipy.special import ndtr, stdtr

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.numerics.units import MICROMETRES, covariate_unit, display_unit, length_text
from stitch.plugins.watch.history import History
from stitch.plugins.watch.onset import find_onset
from stitch.plugins.watch.state_bank import COVARIATES, SLOPE, Bank, predicted_bank
from stitch.plugins.watch.tracking import Alarm, smoothed_states
from stitch.plugins.watch.update import (
    DAY_SECONDS,
    SessionColumns,
    last_state,
    session_columns,
    sessions_after,
    sessions_from,
    state_or_first,
    stored_alarms,
)

HORIZON = 180.0  # days that are looked ahead
_RISK = 0.05
_STEPS = 720
# Sessions before and after an onset that tell what began there, and how few tell nothing.
_AROUND, _FEWEST = 300, 3
# A slope or a share of a channel that is so unlikely by chance is named (per parameter and channel).
_FOLLOWS_P_LIMIT = 1e-4
# Expanded uncertainty: within which a calibration claims to be right.
_COVERAGE_FACTOR = 2.0
# Sessions that a page shows: a month of 20 a day.
MAX_SESSIONS = 600
# Steps of several parameters that begin within so many seconds are one event.
_TOGETHER = 24 * 3600.0
# Sessions that scatter by more than so many stated sigmas are remarked.
_WIDE = 2.0
_PLACES = {"hand_eye": "the mount"}


def days_valid(bank: Bank, conditions: Array, in_use: Array, limits: Array) -> Array:
    """(P,) days from the last session until a parameter may have left its limits; inf beyond `HORIZON`, 0 where it has.

    What all sessions have in common is in the calibration too, and does not count.

    Args:
        bank: after the last session, one member a parameter.
        conditions: (c,) covariates of the calibration in use.
        in_use: (P,) values in use; NaN where it has none.
        limits: (P,) how far a parameter may be off.
    """
    x = np.concatenate([[1.0, 0.0], conditions])
    ahead = np.linspace(0.0, HORIZON, _STEPS + 1)
    risk = np.zeros((len(ahead), len(in_use)))
    for k, days in enumerate(ahead):
        then = predicted_bank(bank, float(days))
        off = bank.origin + bank.unit * (then.mean[:, 0] @ x) - in_use
        sigma = bank.unit * np.sqrt(np.maximum(x @ then.covariance[:, 0] @ x, 0.0) * bank.scatter[:, 0])
        sigma = np.maximum(sigma, 1e-12 * limits)
        risk[k] = ndtr((off - limits) / sigma) + ndtr((-limits - off) / sigma)
    late = np.nan_to_num(risk) > _RISK
    return np.where(late.any(axis=0), ahead[np.argmax(late, axis=0)], np.inf)


@dataclass(frozen=True)
class Change:
    """One event of one parameter."""

    parameter: int
    since: int  # id of the first session that has moved
    raised: int  # id of the session with which it was seen
    kind: str  # step | drift
    channel: str | None  # beside which channel it moves; None: at once, or with time
    size: float  # of a step; of a drift per day, or per unit of the channel
    sigma: float
    p_value: float
    chart: str


def find_changes(history: History) -> list[Change]:
    """All events in the order in which they were raised; a drift that goes on is one."""
    alarms, out = stored_alarms(history), list[Change]()
    order = {run: k for k, (run,) in enumerate(history.sql("SELECT id FROM runs ORDER BY time, id"))}
    for parameter in sorted({a.parameter for a in alarms}):
        own = sorted((a for a in alarms if a.parameter == parameter), key=lambda a: order[a.raised])
        drifting = False
        for i in range(len(own)):
            found = _assess_change(history, own, i, order, drifting)
            if not (drifting and found.kind == "drift"):
                out.append(found)
            drifting = found.kind == "drift"
    return sorted(out, key=lambda c: (order[c.raised], c.parameter))


def _assess_change(history: History, own: Sequence[Alarm], i: int, order: dict[int, int], drifting: bool) -> Change:
    """Judged from the event before until the next was seen.

    Args:
        drifting: it moved steadily before; what comes on top is asked for.
    """
    alarm, at = own[i], order[own[i].onset]
    begin = max(order[own[i - 1].onset] if i else 0, at - _AROUND)
    end = min(order[own[i + 1].raised] if i + 1 < len(own) else len(order), max(at + _AROUND, order[alarm.raised] + 1))
    runs = list(order)[begin:end]
    sessions, found = sessions_from(history, runs), None
    values = sessions.values[:, alarm.parameter]
    if np.isfinite(values).sum() >= _FEWEST:
        base = [sessions.covariates, sessions.days[:, None]] if drifting else [sessions.covariates]
        found = find_onset(
            values=values,
            sigmas=sessions.sigmas[:, alarm.parameter],
            days=sessions.days,
            covariates=np.hstack(base),
            channels=sessions.channels,
        )
    shape = "step" if found is None else found.shape
    return Change(
        parameter=alarm.parameter,
        since=alarm.onset if found is None else runs[found.session],
        raised=alarm.raised,
        kind="step" if shape == "step" else "drift",
        channel=None if shape in ("step", "drift") else shape,
        size=np.nan if found is None else found.size,
        sigma=np.nan if found is None else found.sigma,
        p_value=np.nan if found is None else found.p_value,
        chart=alarm.chart,
    )


@dataclass(frozen=True)
class FollowedChannel:
    """A channel that a parameter follows."""

    channel: str
    per_unit: float
    sigma: float
    p_value: float


@dataclass(frozen=True)
class ParameterReport:
    """One parameter, in its unit."""

    name: str
    unit: str
    value: float  # at the conditions of the last session
    sigma: float  # with what all sessions have in common
    common_sigma: float
    scatter: float  # of sessions, as a share of their stated sigmas
    drift_per_day: float
    drift_sigma: float
    process_noise: float  # per √day, of the likeliest member
    follows: tuple[FollowedChannel, ...]
    in_use: float  # in the calibration in use; NaN where that does not have it
    limit: float  # how far from there it may be
    valid_until: float | None  # s since 1970; None beyond the horizon
    own_sigma: float  # of the value, without what all sessions have in common
    changes: tuple[Change, ...]
    alarm: Change | None  # the latest that stands

    @property
    def too_uncertain(self) -> bool:
        """True where even a parameter that has not moved might be beyond its limit."""
        return bool(2 * ndtr(-self.limit / max(self.own_sigma, 1e-300)) > _RISK)


@dataclass(frozen=True)
class CellReport:
    """A cell after its last session."""

    name: str
    length_unit: str
    sessions: int
    first: float  # s since 1970
    last: float
    in_use: str  # name of the session whose calibration is used
    parameters: tuple[ParameterReport, ...]
    run_names: dict[int, str]  # of the sessions that changes name
    run_times: dict[int, float]
    run_length: float

    @property
    def alarms(self) -> list[tuple[ParameterReport, Change]]:
        """Those that stand, in the order of their onsets."""
        standing = [(p, p.alarm) for p in self.parameters if p.alarm is not None]
        return sorted(standing, key=lambda item: self.run_times[item[1].since])

    @property
    def recalibrate_before(self) -> float | None:
        """The earliest end of validity, s since 1970; of parameters that are known well enough to say."""
        known = (p.valid_until for p in self.parameters if p.valid_until is not None and not p.too_uncertain)
        return min(known, default=None)

    @property
    def too_uncertain(self) -> list[ParameterReport]:
        """Those of which nobody can say whether they are within their limits, the worst first."""
        found = [p for p in self.parameters if p.too_uncertain]
        return sorted(found, key=lambda p: p.limit / max(p.own_sigma, 1e-300))


def cell_report(history: History, tolerance: float | None = None) -> CellReport:
    """What is known after the last session.

    Args:
        tolerance: how far a point of the part may be displaced by the mount, length_unit; without it a parameter may
            be off by the expanded uncertainty (k = 2) that the calibration in use states.

    Raises:
        InputError: the history is empty.
    """
    found = last_state(history)
    if found is None:
        raise InputError(f"{history.folder}: has no sessions yet; to fix: append one with --add RUN")
    names, bank, events = session_columns(history), found.state.bank, find_changes(history)
    last_run, last = history.sql("SELECT id, time FROM runs ORDER BY time DESC, id DESC LIMIT 1")[0]
    calibration = history.stated("in_use")
    used, in_use, used_time = history.sql("SELECT id, name, time FROM runs WHERE run_hash = ?", calibration)[0]
    ends = sessions_from(history, [used, last_run])
    at = {run: k for k, run in enumerate(ends.ids)}
    limits = _parameter_limits(history, names, ends.sigmas[at[used]], tolerance)
    best = bank.chosen(bank.best)
    days = days_valid(best, ends.covariates[at[used]], ends.values[at[used]], limits)
    # As the last session states them that shows a parameter, else the first.
    stated = np.where(np.isfinite(ends.sigmas[-1]), ends.sigmas[-1], best.unit)
    common = np.sqrt(np.maximum(1 - best.scatter[:, 0], 0.0)) * stated
    named = {run for change in events for run in (change.since, change.raised)}
    rows = [history.sql("SELECT id, name, time FROM runs WHERE id = ?", run)[0] for run in named]
    times = {run: float(time) for run, _, time in rows}
    parameters = [
        _assess_parameter(p, names, best, _likeliest_sloped(bank), ends.covariates[at[last_run]], common[p])
        | {"in_use": float(ends.values[at[used], p]), "limit": float(limits[p])}
        | {"valid_until": float(last + DAY_SECONDS * days[p]) if np.isfinite(days[p]) else None}
        | _standing_events(p, events, times, used_time, _likeliest_sloped(bank))
        for p in range(len(names.parameters))
    ]
    return CellReport(
        name=history.folder.resolve().name,
        length_unit=str(history.stated("length_unit")),
        sessions=found.number,
        first=float(history.sql("SELECT min(time) FROM runs")[0][0]),
        last=float(last),
        in_use=str(in_use),
        parameters=tuple(ParameterReport(**p) for p in parameters),  # type: ignore[arg-type]
        run_names={run: str(name) for run, name, _ in rows},
        run_times=times,
        run_length=float(history.stated("run_length")),
    )


def _assess_parameter(
    p: int, names: SessionColumns, best: Bank, sloped: Bank, conditions: Array, common: float
) -> dict[str, object]:
    x = np.concatenate([[1.0, 0.0], conditions])
    unit, scatter = best.unit[p], best.scatter[p, 0]
    own = unit * np.sqrt(max(x @ best.covariance[p, 0] @ x, 0.0) * scatter)
    slope, variance = sloped.mean[p, 0, SLOPE], sloped.covariance[p, 0, SLOPE, SLOPE] * sloped.scatter[p, 0]
    return {
        "name": names.parameters[p],
        "unit": names.units[p],
        "value": float(best.origin[p] + unit * (best.mean[p, 0] @ x)),
        "sigma": float(np.hypot(own, common)),
        "own_sigma": float(own),
        "common_sigma": float(common),
        "scatter": float(np.sqrt(scatter)),
        "drift_per_day": float(unit * slope),
        "drift_sigma": float(unit * np.sqrt(max(variance, 0.0))),
        "process_noise": float(unit * np.sqrt(best.noise[p, 0, 0] * scatter)),
        "follows": tuple(_followed_channels(p, names, best)),
    }


def _followed_channels(p: int, names: SessionColumns, best: Bank) -> list[FollowedChannel]:
    out = []
    for c, channel in enumerate(names.channels):
        size = best.mean[p, 0, COVARIATES + c]
        sigma = np.sqrt(best.covariance[p, 0, COVARIATES + c, COVARIATES + c] * best.scatter[p, 0])
        p_value = 2 * float(stdtr(max(best.count[p] - 4, 1), -abs(size) / max(sigma, 1e-300)))
        if p_value < _FOLLOWS_P_LIMIT:
            out.append(FollowedChannel(channel, float(best.unit[p] * size), float(best.unit[p] * sigma), p_value))
    return out


def _standing_events(
    p: int, events: list[Change], times: dict[int, float], used: float, sloped: Bank
) -> dict[str, object]:
    """Changes of a parameter; an alarm stands until a calibration after it is in use, a drift as long as it goes on."""
    own = tuple(c for c in events if c.parameter == p)
    slope, sigma = sloped.mean[p, 0, SLOPE], np.sqrt(sloped.covariance[p, 0, SLOPE, SLOPE] * sloped.scatter[p, 0])
    moves = 2 * stdtr(max(sloped.count[p] - 4, 1), -abs(slope) / max(sigma, 1e-300)) < _FOLLOWS_P_LIMIT
    standing = [c for c in own if times[c.since] > used or (c.kind == "drift" and moves)]
    return {"changes": own, "alarm": max(standing, key=lambda c: times[c.raised], default=None)}


def _likeliest_sloped(bank: Bank) -> Bank:
    """The likeliest member that believes in a slope."""
    believes = np.flatnonzero(bank.covariance[:, :, SLOPE, SLOPE].min(axis=0) > 0)
    return bank.chosen(believes[np.argmax(bank.log_likelihood[:, believes], axis=1)])


def _parameter_limits(history: History, names: SessionColumns, sigmas: Array, tolerance: float | None) -> Array:
    """(P,) how far a parameter may be from the calibration in use; NaN where that does not have it."""
    limits = _COVERAGE_FACTOR * sigmas
    if tolerance is not None:
        radius = float(history.stated("radius"))
        own = {f"hand_eye.{axis}": tolerance for axis in "xyz"}
        own |= {f"hand_eye.r{axis}": tolerance / radius if radius > 0 else np.inf for axis in "xyz"}
        limits = np.array([own.get(name, limit) for name, limit in zip(names.parameters, limits, strict=True)])
    return np.asarray(limits, float)


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
    smoothed, own_sigmas = smoothed_states(state_or_first(history, kept), sessions, moved, last.state)
    part = slice(max(len(sessions.ids) - max_sessions, 0), None)
    common = np.array([p.common_sigma for p in report.parameters])
    times = dict(history.sql("SELECT id, time FROM runs"))
    return CellTrend(
        report=report,
        times=np.array([times[run] for run in sessions.ids[part]]),
        values=sessions.values[part],
        sigmas=sessions.sigmas[part],
        smoothed=smoothed[part],
        smoothed_sigmas=np.hypot(own_sigmas[part], common),
        in_use=calibration_in_use(history, len(report.parameters)),
        channels=_channels(history, list(sessions.ids[part])),
    )


def calibration_in_use(history: History, parameters: int) -> Array:
    """(P,) values in the calibration in use; NaN where it has none."""
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


_Alarmed = tuple[ParameterReport, Change]


def headline(report: CellReport) -> str:
    """The verdict on a cell in one line."""
    told = event_sentences(report) or [f"nothing moves in {sessions_text(report)}"]
    return f"{report.name}: {'; '.join(told)}; {_recalibration_note(report)}."


def sessions_text(report: CellReport) -> str:
    """How many sessions there are, in words."""
    return f"{report.sessions:,} session{'s' * (report.sessions != 1)}"


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
        one = covariate_unit(change.channel) or "unit"
        return f"{parameter.name} follows {change.channel} since session {since}, {per} per {one}"
    per_day = size_text(change.size, parameter.unit, change.sigma)
    share = change.size / parameter.in_use if parameter.in_use and effect != "hand_eye" else float("nan")
    rate = f"{100 * share:+.2g} % a day" if np.isfinite(share) else f"{per_day} a day"
    return f"{parameter.name} drifts since session {since}, {rate}"


def uncertainty_note(report: CellReport) -> str:
    """Return what is not known well enough to be judged, as a sentence without its full stop; empty where all is."""
    if not report.too_uncertain:
        return ""
    p = report.too_uncertain[0]
    known, allowed = size_text(float(f"{2 * p.own_sigma:.2g}"), p.unit), size_text(float(f"{p.limit:.2g}"), p.unit)
    return f"{p.name} is known to ± {known} (k = 2), allowed are {allowed}: more sessions tell whether it holds"


def _recalibration_note(report: CellReport) -> str:
    end = report.recalibrate_before
    if report.too_uncertain and (end is None or end > report.last):
        return uncertainty_note(report)
    if end is None:
        return "the calibration in use holds"
    if end <= report.last:
        return "the calibration in use does not hold: recalibrate now"
    return f"recalibrate before {day_text(end)}"


def table_unit(unit: str, length_unit: str) -> tuple[float, str]:
    """Factor and name: lengths in µm, the rest as everywhere."""
    if unit == length_unit:
        return MICROMETRES[length_unit], "µm"
    return display_unit(unit)
