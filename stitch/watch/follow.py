"""Session after session: the bank goes on, the charts watch its innovations, and what alarms is followed anew.

An alarm names an onset in the past. From there on level and slope of the parameter are open again and its charts begin
at zero, so that a second event after a first is seen as well. To go back costs the sessions since the onset; states are
kept at intervals for that.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.watch.control_charts import (
    CHART_NAMES,
    ODDS,
    Charts,
    chart_limits,
    empty_charts,
    extended_charts,
    limit_shares,
    odds_limit,
    restarted,
    updated_charts,
)
from stitch.watch.onset import find_onset
from stitch.watch.slope_odds import slope_odds
from stitch.watch.state_bank import Bank, empty_bank, predicted_bank, reset_moved, updated_bank, with_parameters


@dataclass(frozen=True)
class Sessions:
    """n sessions in the order of time, P parameters, c covariates of which the first are the channels."""

    ids: Sequence[int]
    days: Array  # (n,)
    values: Array  # (n, P) NaN where a session does not show a parameter
    sigmas: Array  # (n, P)
    covariates: Array  # (n, c) less those of the first
    prior_sigmas: Array  # (c,) how far, in sigmas, a parameter may follow each by one unit
    channels: Sequence[str]


@dataclass(frozen=True)
class CellState:
    """What is known after a session."""

    bank: Bank
    charts: Charts
    day: float  # of the session


@dataclass(frozen=True)
class Alarm:
    """A chart of a parameter beyond its limit."""

    parameter: int
    onset: int  # id of the first session that has moved
    raised: int  # id of the session with which it was seen
    chart: str


def first_state(covariates: int) -> CellState:
    """Before the first session."""
    return CellState(empty_bank(covariates), empty_charts(0), 0.0)


def next_state(state: CellState, sessions: Sessions, k: int, moved: Collection[int] = ()) -> CellState:
    """The state after session k.

    Args:
        moved: parameters to which something happened just before this session.
    """
    values, sigmas = sessions.values[k], sessions.sigmas[k]
    bank, charts = state.bank, state.charts
    known = len(bank.origin)
    if len(values) > known:
        fresh = _first_values(sessions, known)
        bank, charts = (
            with_parameters(bank, *fresh, sessions.prior_sigmas),
            extended_charts(charts, len(values) - known),
        )
    bank = predicted_bank(bank, max(sessions.days[k] - state.day, 0.0))
    if moved:
        mask = np.isin(np.arange(len(values)), list(moved))
        bank, charts = reset_moved(bank, mask), restarted(charts, mask)
    bank, innovations = updated_bank(bank, values, sigmas, sessions.covariates[k])
    return CellState(bank, updated_charts(charts, innovations), float(sessions.days[k]))


def _first_values(sessions: Sessions, known: int) -> tuple[Array, Array]:
    """First value and first sigma of the parameters from number `known` on."""
    values, sigmas = sessions.values[:, known:], sessions.sigmas[:, known:]
    seen = np.isfinite(values) & (sigmas > 0)
    first, own = np.argmax(seen, axis=0), np.arange(values.shape[1])
    told = seen.any(axis=0)
    return np.where(told, values[first, own], 0.0), np.where(told, sigmas[first, own], 1.0)


def alarming_parameters(state: CellState, run_length: float) -> list[tuple[int, str]]:
    """Parameters whose charts are beyond their limits, with the chart that is farthest."""
    parameters = len(state.bank.origin)
    share = np.column_stack(
        [
            limit_shares(state.charts, chart_limits(run_length, parameters)),
            slope_odds(state.bank) / odds_limit(parameters),
        ]
    )
    return [(int(p), (*CHART_NAMES, ODDS)[int(np.argmax(share[p]))]) for p in np.flatnonzero(share.max(axis=1) >= 1)]


def raise_alarm(sessions: Sessions, k: int, parameter: int, chart: str, before: Sequence[Alarm]) -> Alarm:
    """The alarm of a parameter at session k, with its onset after the last alarm that the parameter had."""
    ids = list(sessions.ids)
    last = max((ids.index(a.raised) for a in before if a.parameter == parameter and a.raised in ids), default=0)
    last = min(last, k - 1) if k else 0
    part = slice(last, k + 1)
    found = find_onset(
        values=sessions.values[part, parameter],
        sigmas=sessions.sigmas[part, parameter],
        days=sessions.days[part],
        covariates=sessions.covariates[part],
        channels=sessions.channels,
    )
    onset = k if found is None else last + max(found.session, 1 if last < k else 0)
    return Alarm(parameter, ids[onset], ids[k], chart)
