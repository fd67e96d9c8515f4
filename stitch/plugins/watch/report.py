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
from stitch.plugins.watch.tracking import Alarm, Sessions, smoothed_states
from stitch.plugins.watch.update import (
    DAY_SECONDS,
    last_state,
    sessions_after,
    sessions_from,
    stored_alarms,
    stored_parameters,
)
from stitch.system.values import Table

HORIZON = 180.0  # days that are looked ahead
# A parameter has left its limits where that is more probable; it is asked for so often within the horizon.
_RISK = 0.05
_STEPS = 720
# Sessions before and after an onset that tell what began there, and how few tell nothing.
_AROUND = 300
_FEWEST = 3
# A slope or a share of a channel that is so unlikely by chance is named (per parameter and channel).
_FOLLOWS_P_LIMIT = 1e-4
# Expanded uncertainty: within which a calibration claims to be right.
_COVERAGE_FACTOR = 2.0
# Sessions that a page shows: a month of 20 a day.
_MOST_SESSIONS = 600
# Steps of several parameters that begin within so many seconds are one event.
_TOGETHER = 24 * 3600.0
# Sessions that scatter by more than so many stated sigmas are remarked.
_WIDE = 2.0
_PLACES = {"hand_eye": "the mount"}


@dataclass(frozen=True)
class Change:
    """One event of one parameter.

    Example:
        >>> saved = run.save(folder / "monday", recording=False)
        >>> [change.kind for _, change in stitch.watch(folder / "cell-7", [saved]).alarms]
        []
    """

    parameter: int
    since: int  # id of the first session that has moved
    raised: int  # id of the session with which it was seen
    kind: str  # step | drift
    channel: str | None  # beside which channel it moves; None: at once, or with time
    size: float  # of a step; of a drift per day, or per unit of the channel
    sigma: float
    p_value: float
    chart: str


@dataclass(frozen=True)
class FollowedChannel:
    """A channel that a parameter follows."""

    channel: str
    per_unit: float
    sigma: float
    p_value: float


@dataclass(frozen=True)
class ParameterReport:
    """One parameter, in its unit.

    Example:
        >>> saved = run.save(folder / "monday", recording=False)
        >>> stitch.watch(folder / "cell-7", [saved]).parameters[0].name.split(".")[0]
        'hand_eye'
    """

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


@dataclass(frozen=True, eq=False)
class CellReport(Table, document="stitch.plugins.watch.exported:report_document", table="parameters"):
    """Parameters of a cell after its last session, and what moves.

    Example:
        >>> saved = run.save(folder / "monday", recording=False)
        >>> report = stitch.watch(folder / "cell-7", [saved])
        >>> report.name, report.alarms, report.rows()[0]["name"] == report.parameters[0].name
        ('cell-7', [], True)
    """

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
        uncertain = [p for p in self.parameters if p.too_uncertain]
        return sorted(uncertain, key=lambda p: p.limit / max(p.own_sigma, 1e-300))


def cell_report(history: History, tolerance: float | None = None) -> CellReport:
    """What is known after the last session.

    Args:
        tolerance: how far a point of the part may be displaced by the mount, length_unit; without it a parameter may
            be off by the expanded uncertainty (k = 2) that the calibration in use states.

    Raises:
        InputError: the history is empty.
    """
    state = last_state(history)
    if not state.number:
        raise InputError(f"{history.folder}: has no sessions yet; to fix: append one with --add RUN")
    events = find_changes(history)
    last_run, last = history.sql("SELECT id, time FROM runs ORDER BY time DESC, id DESC LIMIT 1")[0]
    calibration = history.stated("in_use")
    used, in_use, used_time = history.sql("SELECT id, name, time FROM runs WHERE run_hash = ?", calibration)[0]
    named = {run for change in events for run in (change.since, change.raised)}
    rows = [history.sql("SELECT id, name, time FROM runs WHERE id = ?", run)[0] for run in named]
    times = {run: float(time) for run, _, time in rows}
    sloped = _likeliest_sloped(state.bank)
    ends = sessions_from(history, [used, last_run])
    at = [ends.ids.index(run) for run in (used, last_run)]
    numbers, days = _parameter_numbers(history, state.bank, ends, at, tolerance)
    best = state.bank.chosen(state.bank.best)
    parameters = []
    for p, (name, unit) in enumerate(stored_parameters(history)):
        slope, slope_sigma, slope_p_value = _significance(sloped, p, SLOPE)
        changes = tuple(c for c in events if c.parameter == p)
        # An alarm stands until a calibration after it is in use, a drift as long as it goes on.
        moves = slope_p_value < _FOLLOWS_P_LIMIT
        standing = [c for c in changes if times[c.since] > used_time or (c.kind == "drift" and moves)]
        parameters.append(
            ParameterReport(
                name=name,
                unit=unit,
                **{key: float(of_all[p]) for key, of_all in numbers.items()},
                drift_per_day=float(best.unit[p] * slope),
                drift_sigma=float(best.unit[p] * slope_sigma),
                follows=_followed_channels(p, ends.channels, best),
                valid_until=float(last + DAY_SECONDS * days[p]) if np.isfinite(days[p]) else None,
                changes=changes,
                alarm=max(standing, key=lambda c: times[c.raised], default=None),
            )
        )
    return CellReport(
        name=history.folder.resolve().name,
        length_unit=str(history.stated("length_unit")),
        sessions=state.number,
        first=float(history.sql("SELECT min(time) FROM runs")[0][0]),
        last=float(last),
        in_use=str(in_use),
        parameters=tuple(parameters),
        run_names={run: str(name) for run, name, _ in rows},
        run_times=times,
        run_length=float(history.stated("run_length")),
    )


def _parameter_numbers(
    history: History, bank: Bank, ends: Sessions, at: Sequence[int], tolerance: float | None
) -> tuple[dict[str, Array], Array]:
    """Return numbers (P,) of all parameters by the fields of `ParameterReport`, and days (P,) that they stay valid.

    Args:
        bank: after the last session.
        ends: holds the session whose calibration is in use, and the last one.
        at: where these two stand in it.
        tolerance: as of `cell_report`.
    """
    used, last = at
    best = bank.chosen(bank.best)
    scatter = best.scatter[:, 0]
    x = np.concatenate([[1.0, 0.0], ends.covariates[last]])
    # As the last session states them that shows a parameter, else the first.
    stated = np.where(np.isfinite(ends.sigmas[-1]), ends.sigmas[-1], best.unit)
    common = np.sqrt(np.maximum(1 - scatter, 0.0)) * stated
    own_sigma = best.unit * np.sqrt(np.maximum(x @ best.covariance[:, 0] @ x, 0.0) * scatter)
    limits = _parameter_limits(history, ends.sigmas[used], tolerance)
    numbers = {
        "value": best.origin + best.unit * (best.mean[:, 0] @ x),
        "sigma": np.hypot(own_sigma, common),
        "common_sigma": common,
        "scatter": np.sqrt(scatter),
        "process_noise": best.unit * np.sqrt(best.noise[:, 0, 0] * scatter),
        "in_use": ends.values[used],
        "limit": limits,
        "own_sigma": own_sigma,
    }
    return numbers, days_valid(best, ends.covariates[used], ends.values[used], limits)


def _parameter_limits(history: History, sigmas: Array, tolerance: float | None) -> Array:
    """(P,) how far a parameter may be from the calibration in use; NaN where that does not have it."""
    limits = _COVERAGE_FACTOR * sigmas
    if tolerance is None:
        return limits
    radius = float(history.stated("radius"))
    of_mount = {f"hand_eye.{axis}": tolerance for axis in "xyz"}
    of_mount |= {f"hand_eye.r{axis}": tolerance / radius if radius > 0 else np.inf for axis in "xyz"}
    names = [name for name, _ in stored_parameters(history)]
    return np.array([of_mount.get(name, limit) for name, limit in zip(names, limits, strict=True)], float)


def _likeliest_sloped(bank: Bank) -> Bank:
    """The likeliest member that believes in a slope."""
    believes = np.flatnonzero(bank.covariance[:, :, SLOPE, SLOPE].min(axis=0) > 0)
    return bank.chosen(believes[np.argmax(bank.log_likelihood[:, believes], axis=1)])


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


def _significance(bank: Bank, p: int, number: int) -> tuple[float, float, float]:
    """A number of a parameter, its sigma, both in the parameter's first sigma, and the p-value of its being zero."""
    size = bank.mean[p, 0, number]
    sigma = np.sqrt(max(bank.covariance[p, 0, number, number] * bank.scatter[p, 0], 0.0))
    return size, sigma, 2 * float(stdtr(max(bank.count[p] - 4, 1), -abs(size) / max(sigma, 1e-300)))


def _followed_channels(p: int, channels: Sequence[str], best: Bank) -> tuple[FollowedChannel, ...]:
    followed = []
    for c, channel in enumerate(channels):
        size, sigma, p_value = _significance(best, p, COVARIATES + c)
        if p_value < _FOLLOWS_P_LIMIT:
            followed.append(FollowedChannel(channel, float(best.unit[p] * size), float(best.unit[p] * sigma), p_value))
    return tuple(followed)


def find_changes(history: History) -> list[Change]:
    """All events in the order in which they were raised; a drift that goes on is one."""
    alarms = stored_alarms(history)
    changes = list[Change]()
    order = {run: k for k, (run,) in enumerate(history.sql("SELECT id FROM runs ORDER BY time, id"))}
    for parameter in sorted({a.parameter for a in alarms}):
        of_parameter = sorted((a for a in alarms if a.parameter == parameter), key=lambda a: order[a.raised])
        drifting = False
        for i in range(len(of_parameter)):
            change = _assess_change(history, of_parameter, i, order, drifting)
            if not (drifting and change.kind == "drift"):
                changes.append(change)
            drifting = change.kind == "drift"
    return sorted(changes, key=lambda c: (order[c.raised], c.parameter))


def _assess_change(history: History, alarms: Sequence[Alarm], i: int, order: dict[int, int], drifting: bool) -> Change:
    """The change of alarm i of a parameter, judged from the event before until the next was seen.

    Args:
        drifting: it moved steadily before; what comes on top is asked for.
    """
    alarm = alarms[i]
    at = order[alarm.onset]
    begin = max(order[alarms[i - 1].onset] if i else 0, at - _AROUND)
    next_raised = order[alarms[i + 1].raised] if i + 1 < len(alarms) else len(order)
    runs = list(order)[begin : min(next_raised, max(at + _AROUND, order[alarm.raised] + 1))]
    sessions = sessions_from(history, runs)
    values = sessions.values[:, alarm.parameter]
    onset = None
    if np.isfinite(values).sum() >= _FEWEST:
        base = [sessions.covariates, sessions.days[:, None]] if drifting else [sessions.covariates]
        onset = find_onset(
            values=values,
            sigmas=sessions.sigmas[:, alarm.parameter],
            days=sessions.days,
            covariates=np.hstack(base),
            channels=sessions.channels,
        )
    if onset is None:
        nan = float("nan")
        return Change(alarm.parameter, alarm.onset, alarm.raised, "step", None, nan, nan, nan, alarm.chart)
    return Change(
        parameter=alarm.parameter,
        since=runs[onset.session],
        raised=alarm.raised,
        kind="step" if onset.shape == "step" else "drift",
        channel=None if onset.shape in ("step", "drift") else onset.shape,
        size=onset.size,
        sigma=onset.sigma,
        p_value=onset.p_value,
        chart=alarm.chart,
    )


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


def cell_trend(history: History, report: CellReport) -> CellTrend:
    """The last sessions of a cell, smoothed."""
    rows = history.sql("SELECT time FROM runs ORDER BY time DESC, id DESC LIMIT ?", _MOST_SESSIONS)
    kept = last_state(history, before=rows[-1][0])
    sessions = sessions_after(history, kept)
    moved = defaultdict(list)
    for alarm in stored_alarms(history):
        moved[alarm.onset].append(alarm.parameter)
    smoothed, own_sigmas = smoothed_states(kept, sessions, moved, last_state(history))
    part = slice(max(len(sessions.ids) - _MOST_SESSIONS, 0), None)
    common = np.array([p.common_sigma for p in report.parameters])
    times = dict(history.sql("SELECT id, time FROM runs"))
    place = {run: k for k, run in enumerate(sessions.ids[part])}
    channels = {name: np.full(len(place), np.nan) for name in history.stated("channels")}
    for run, name, value in history.sql("SELECT run, name, value FROM covariates"):
        if run in place and name in channels:
            channels[name][place[run]] = value
    return CellTrend(
        report=report,
        times=np.array([times[run] for run in sessions.ids[part]]),
        values=sessions.values[part],
        sigmas=sessions.sigmas[part],
        smoothed=smoothed[part],
        smoothed_sigmas=np.hypot(own_sigmas[part], common),
        in_use=calibration_in_use(history, len(report.parameters)),
        channels=channels,
    )


def calibration_in_use(history: History, parameters: int) -> Array:
    """(P,) values in the calibration in use; NaN where it has none."""
    values = np.full(parameters, np.nan)
    query = "SELECT parameter, value FROM estimates WHERE run = (SELECT id FROM runs WHERE run_hash = ?)"
    for parameter, value in history.sql(query, history.stated("in_use")):
        values[parameter - 1] = value
    return values


_Alarmed = tuple[ParameterReport, Change]


def headline(report: CellReport) -> str:
    """The verdict on a cell in one line."""
    events = event_sentences(report) or [f"nothing moves in {sessions_text(report)}"]
    return f"{report.name}: {'; '.join(events)}; {_recalibration_note(report)}."


def sessions_text(report: CellReport) -> str:
    """How many sessions there are, in words."""
    return f"{report.sessions:,} session{'s' * (report.sessions != 1)}"


def event_sentences(report: CellReport) -> list[str]:
    """One for every event that stands, in the order of their onsets."""
    left = sorted(report.alarms, key=lambda alarmed: _significance_rank(alarmed[1]))
    groups = list[list[_Alarmed]]()
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
    if sigma is not None and np.isfinite(sigma):
        value = float(f"{value:.{_digits(value, sigma)}g}")
    if unit in ("mm", "m"):
        return length_text(value, unit)
    factor, name = display_unit(unit)
    return f"{factor * value:.4g} {name}"


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
