"""A history judged: where the parameters of the cell are, what stands, what may still be used."""

import numpy as np
from scipy.special import stdtr

from stitch.errors import InputError
from stitch.frames import Array
from stitch.watch.catch_up import last_state
from stitch.watch.cell_report import CellReport, FollowedChannel, ParameterReport
from stitch.watch.changes import Change, find_changes
from stitch.watch.history import History
from stitch.watch.regressors import DAY_SECONDS
from stitch.watch.state_bank import COVARIATES, SLOPE, Bank
from stitch.watch.stored_sessions import SessionColumns, session_columns, sessions_from
from stitch.watch.validity import days_valid

# A slope or a share of a channel that is so unlikely by chance is named (per parameter and channel).
_FOLLOWS_P_LIMIT = 1e-4
# Expanded uncertainty: within which a calibration claims to be right.
_COVERAGE_FACTOR = 2.0


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
    common = np.sqrt(np.maximum(1 - best.scatter[:, 0], 0.0)) * _typical_sigmas(ends.sigmas, best)
    run_names, times = _runs_of(history, events)
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
        run_names=run_names,
        run_times=times,
        run_length=float(history.stated("run_length")),
    )


def _runs_of(history: History, events: list[Change]) -> tuple[dict[int, str], dict[int, float]]:
    """Names and times of the sessions that events name."""
    runs = {run for c in events for run in (c.since, c.raised)}
    rows = [history.sql("SELECT id, name, time FROM runs WHERE id = ?", run)[0] for run in runs]
    return {run: str(name) for run, name, _ in rows}, {run: float(time) for run, _, time in rows}


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


def _typical_sigmas(sigmas: Array, bank: Bank) -> Array:
    """(P,) stated sigma: of the last session that shows a parameter, else of the first."""
    return np.where(np.isfinite(sigmas[-1]), sigmas[-1], bank.unit)


def _parameter_limits(history: History, names: SessionColumns, sigmas: Array, tolerance: float | None) -> Array:
    """(P,) how far a parameter may be from the calibration in use; NaN where that does not have it."""
    limits = _COVERAGE_FACTOR * sigmas
    if tolerance is not None:
        radius = float(history.stated("radius"))
        own = {f"hand_eye.{axis}": tolerance for axis in "xyz"}
        own |= {f"hand_eye.r{axis}": tolerance / radius if radius > 0 else np.inf for axis in "xyz"}
        limits = np.array([own.get(name, limit) for name, limit in zip(names.parameters, limits, strict=True)])
    return np.asarray(limits, float)
