"""Session after session: the bank goes on, the charts watch its innovations, and what alarms is followed anew.

An alarm names an onset in the past. From there on level and slope of the parameter are open again and its charts begin
at zero, so that a second event after a first is seen as well. To go back costs the sessions since the onset; states are
kept at intervals for that.

Where every parameter was, seen from now, is the fixed-interval smoother of the likeliest member of the bank (Rauch,
Tung & Striebel 1965, AIAA J. 3:1445). Backwards from the last session it needs the filtered states of as many sessions
as are shown, and no others.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stitch.numerics.frames import Array
from stitch.plugins.watch.control_charts import (
    CHART_NAMES,
    Charts,
    chart_limits,
    empty_charts,
    limit_shares,
    restarted,
    updated_charts,
)
from stitch.plugins.watch.onset import find_onset
from stitch.plugins.watch.state_bank import (
    ODDS,
    Bank,
    empty_bank,
    odds_limit,
    predicted_bank,
    reset_moved,
    slope_odds,
    transition,
    updated_bank,
    with_parameters,
)

# Directions of a predicted covariance below this share of its largest are not known to move.
_SINGULAR = 1e-13


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
    """What is known after a session; by default before the first."""

    bank: Bank
    charts: Charts
    day: float  # of the session, since the first
    run: int = -1  # id of the session
    time: float = -1e300  # s since 1970
    number: int = 0  # of sessions so far


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
    values = sessions.values[k]
    bank = state.bank
    charts = state.charts
    known = len(bank.origin)
    if len(values) > known:
        first_values, first_sigmas = _first_values(sessions, known)
        bank = with_parameters(bank, first_values, first_sigmas, sessions.prior_sigmas)
        more = empty_charts(len(values) - known)
        charts = Charts(np.concatenate([charts.cusums, more.cusums]), np.concatenate([charts.ewma, more.ewma]))
    bank = predicted_bank(bank, max(sessions.days[k] - state.day, 0.0))
    if moved:
        mask = np.isin(np.arange(len(values)), list(moved))
        bank = reset_moved(bank, mask)
        charts = restarted(charts, mask)
    bank, innovations = updated_bank(bank, values, sessions.sigmas[k], sessions.covariates[k])
    return CellState(bank, updated_charts(charts, innovations), float(sessions.days[k]))


def _first_values(sessions: Sessions, known: int) -> tuple[Array, Array]:
    """First value and first sigma of the parameters from number `known` on."""
    values = sessions.values[:, known:]
    sigmas = sessions.sigmas[:, known:]
    is_shown = np.isfinite(values) & (sigmas > 0)
    first = np.argmax(is_shown, axis=0)
    column = np.arange(values.shape[1])
    ever = is_shown.any(axis=0)
    return np.where(ever, values[first, column], 0.0), np.where(ever, sigmas[first, column], 1.0)


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
    change = find_onset(
        values=sessions.values[part, parameter],
        sigmas=sessions.sigmas[part, parameter],
        days=sessions.days[part],
        covariates=sessions.covariates[part],
        channels=sessions.channels,
    )
    onset = k if change is None else last + max(change.session, 1 if last < k else 0)
    return Alarm(parameter, ids[onset], ids[k], chart)


def smoothed_states(
    state: CellState, sessions: Sessions, moved: Mapping[int, Sequence[int]], last: CellState
) -> tuple[Array, Array]:
    """The sessions after a state, smoothed: values (n, P) at the conditions of each session, and their sigmas (n, P)
    without what all sessions have in common; in the parameters' units.

    Args:
        state: just before the first of the sessions.
        moved: by session, parameters to which something happened before it.
        last: the state after the last of them; it says which member is likeliest.
    """
    members = last.bank.best
    # Parameters that came since the state join all members and are thinned with the others.
    filtered = list[Bank]()
    for k, run in enumerate(sessions.ids):
        state = next_state(state, sessions, k, moved.get(run, ()))
        filtered.append(state.bank.chosen(members[: len(state.bank.origin)]))
    return _smooth_backwards(filtered, sessions, moved, last.bank.chosen(members))


def _smooth_backwards(
    filtered: Sequence[Bank], sessions: Sessions, moved: Mapping[int, Sequence[int]], last: Bank
) -> tuple[Array, Array]:
    n = len(filtered)
    P, _, d = last.mean.shape
    means = np.full((n, P, d), np.nan)
    covariances = np.full((n, P, d, d), np.nan)
    mean = means[-1] = filtered[-1].mean[:, 0]
    covariance = covariances[-1] = filtered[-1].covariance[:, 0]
    for k in range(n - 2, -1, -1):
        now = filtered[k]
        known = len(now.origin)
        days = sessions.days[k + 1] - sessions.days[k]
        ahead = predicted_bank(now, max(days, 0.0))
        if happened := moved.get(sessions.ids[k + 1], ()):
            ahead = reset_moved(ahead, np.isin(np.arange(known), list(happened)))
        F = transition(d, max(days, 0.0))
        P_ahead = ahead.covariance[:, 0]
        gain = now.covariance[:, 0] @ F.T @ _inverse(P_ahead)
        mean = now.mean[:, 0] + np.einsum("pij,pj->pi", gain, mean[:known] - ahead.mean[:, 0])
        covariance = now.covariance[:, 0] + gain @ (covariance[:known] - P_ahead) @ np.swapaxes(gain, -1, -2)
        means[k, :known] = mean
        covariances[k, :known] = covariance
    x = np.column_stack([np.ones(n), np.zeros(n), sessions.covariates])
    variance = np.einsum("ni,npij,nj->np", x, covariances, x) * last.scatter[:, 0]
    values = last.origin + last.unit * np.einsum("npi,ni->np", means, x)
    return values, last.unit * np.sqrt(np.maximum(variance, 0.0))


def _inverse(covariance: Array) -> Array:
    """(P, d, d) of symmetric matrices of which some directions may be certain: these stay as they are."""
    diagonal = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    scale = np.where(diagonal > 0, 1 / np.where(diagonal > 0, diagonal, 1.0), 0.0)
    unit = covariance * scale[:, :, None] * scale[:, None, :]
    inverse = np.asarray(np.linalg.pinv(unit, rcond=_SINGULAR, hermitian=True), float)
    return inverse * scale[:, :, None] * scale[:, None, :]
