"""Where every parameter of a cell is, session by session: a bank of Kalman filters with different process noise.

A parameter is level + x·b: a level that moves, and what follows the covariates x of the session (Harvey 1989,
Forecasting, Structural Time Series Models and the Kalman Filter, 2.3). Every member of the bank believes in a process
noise of its own; the likelihood that a member has gathered says how well it predicts, and the best of them is the
process noise by maximum likelihood on a grid (Magill 1965, IEEE Trans. Automat. Contr. 10:434). So a further session
costs one step of the bank, whatever the history.

Member 0 believes that nothing moves. Its innovations are the recursive residuals of a regression (Brown, Durbin & Evans
1975, J. R. Statist. Soc. B 37:149): independent and, divided by the scatter of those before, Student's t. They are what
the control charts watch, from the first sessions on and without a phase of learning (Hawkins 1987, The Statistician
36:463). What a run states of its sigmas weighs like two sessions.

Values count in the first sigma of their parameter; covariances moreover in the unknown share `scatter` of the stated
variances that sessions do not have in common.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import gammaln, ndtr, ndtri, stdtr

from stitch.numerics.frames import Array, Indices, Mask

# How long a control chart stays silent where nothing happens: average run length, and the limit for a wanted one.
#
# Markov chain of Brook & Evans (1972, Biometrika 59:539) for the CUSUM, of Lucas & Saccucci (1990, Technometrics 32:1)
# for the EWMA; innovations standard normal.

_STATES = 121
_STEPS = 36


def cusum_run_length(reference: float, limit: float, shift: float = 0.0) -> float:
    """Average run length of a one-sided CUSUM that begins at zero; innovations of mean `shift`."""
    width = 2 * limit / (2 * _STATES - 1)
    centre = width * np.arange(_STATES)
    edge = (centre + width / 2)[None, :] - centre[:, None] + reference - shift
    upper = ndtr(edge)
    # The first state takes all that would fall below zero.
    chain = np.column_stack([upper[:, 0], np.diff(upper, axis=1)])
    return _mean_exit_time(chain, 0)


def ewma_run_length(weight: float, limit: float, shift: float = 0.0) -> float:
    """Average run length of a two-sided EWMA that begins at zero; `limit` in the units of the EWMA itself."""
    width = 2 * limit / _STATES
    centre = -limit + width * (np.arange(_STATES) + 0.5)
    edges = np.append(centre - width / 2, limit)
    reached = ndtr((edges[None, :] - (1 - weight) * centre[:, None]) / weight - shift)
    return _mean_exit_time(np.diff(reached, axis=1), _STATES // 2)


def cusum_limit(reference: float, run_length: float) -> float:
    """Limit of a CUSUM of which both sides together run so long on average."""
    return _bisect_limit(lambda limit: cusum_run_length(reference, limit) / 2, run_length, 30.0 / (1 + reference) + 10)


def ewma_limit(weight: float, run_length: float) -> float:
    """Limit of a two-sided EWMA that runs so long on average."""
    return _bisect_limit(lambda limit: ewma_run_length(weight, limit), run_length, 12 * np.sqrt(weight / (2 - weight)))


def _mean_exit_time(chain: Array, start: int) -> float:
    """Mean number of steps until the chain is left."""
    return float(np.linalg.solve(np.eye(len(chain)) - chain, np.ones(len(chain)))[start])


def _bisect_limit(run_length_at: Callable[[float], float], target: float, highest: float) -> float:
    """By bisection: run lengths grow with the limit. A chain that is hardly ever left cannot be solved: too high."""
    low, high = 0.0, highest
    for _ in range(_STEPS):
        middle = (low + high) / 2
        length = run_length_at(middle)
        low, high = (middle, high) if 0 < length < target else (low, middle)
    return high


# Numbers of Student's t distribution, elementwise, without the library of all distributions.


def student_log_density(e: Array, spread: Array, freedom: Array) -> Array:
    """(...,) log density of t = e/spread as one of e, up to a constant; `freedom` are the degrees of freedom."""
    told = gammaln((freedom + 1) / 2) - gammaln(freedom / 2) - np.log(freedom) / 2 - np.log(spread)
    return np.asarray(told - (freedom + 1) / 2 * np.log1p((e / spread) ** 2 / freedom))


def normal_equivalent(t: Array, freedom: Array) -> Array:
    """(...,) numbers of Student's t as normal numbers of the same probability."""
    return np.asarray(-np.sign(t) * ndtri(np.maximum(stdtr(freedom, -np.abs(t)), 1e-300)))


LEVEL, SLOPE, COVARIATES = 0, 1, 2
# Process noise of the members: of the level per √day, of the slope at the start per day, of the slope per day and
# √day; standard deviations in sigmas of one session.
MEMBERS = (
    (0.0, 0.0, 0.0),
    (0.1, 0.0, 0.0),
    (0.3, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (3.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 1.0, 0.03),
    (0.0, 1.0, 0.1),
    (0.0, 1.0, 0.3),
    (0.3, 1.0, 0.1),
)
# Variance of what is not known at all, and above which an innovation only says where that is.
_UNKNOWN, _START_VARIANCES = 1e8, 1e5
# A session farther off than so many sigmas counts as so many: one wild session must not carry the level away.
WILD = 4.0
# Degrees of freedom that the stated sigmas are worth: few, for they may be twice too small; enough that a jump of a
# hundred sigmas between the first sessions is no scatter.
_STATED = 2.0


@dataclass(frozen=True)
class Bank:
    """P parameters, M members, d numbers each: level, slope per day, b per unit of each covariate."""

    mean: Array  # (P, M, d)
    covariance: Array  # (P, M, d, d)
    squares: Array  # (P, M) of the innovations in units of their predicted variance
    count: Array  # (P,) innovations that tell of scatter
    log_likelihood: Array  # (P, M)
    noise: Array  # (P, M, 2) variances of level per day, of slope per day³
    origin: Array  # (P,) first value
    unit: Array  # (P,) first sigma

    @property
    def scatter(self) -> Array:
        """(P, M) share of the stated variances in which sessions differ."""
        return np.asarray((self.squares + _STATED) / (self.count + _STATED)[:, None])

    @property
    def best(self) -> Indices:
        """(P,) member by which the sessions so far were likeliest."""
        return np.asarray(np.argmax(self.log_likelihood, axis=1), np.int64)

    def chosen(self, members: Indices) -> "Bank":
        """The bank with one member a parameter (P,) left."""
        rows = np.arange(len(members))
        by_member = ("mean", "covariance", "squares", "log_likelihood", "noise")
        return replace(self, **{name: getattr(self, name)[rows, members][:, None] for name in by_member})


def empty_bank(covariates: int, members: Sequence[tuple[float, float, float]] = MEMBERS) -> Bank:
    """A bank that knows no parameter yet."""
    d, M = COVARIATES + covariates, len(members)
    shapes = {"mean": (M, d), "covariance": (M, d, d), "squares": (M,), "count": (), "log_likelihood": (M,)}
    shapes |= {"noise": (M, 2), "origin": (), "unit": ()}
    return Bank(**{name: np.zeros((0, *shape)) for name, shape in shapes.items()})


def with_parameters(
    bank: Bank,
    values: Array,
    sigmas: Array,
    prior_sigmas: Array | None = None,
    members: Sequence[tuple[float, float, float]] = MEMBERS,
) -> Bank:
    """The bank with further parameters that begin with values and sigmas (K,).

    Args:
        prior_sigmas: (d − 2,) how far, in sigmas, a parameter may follow a covariate by one unit; inf: anything.
    """
    K, M, d = len(values), len(members), bank.mean.shape[2]
    level, start, wander = (np.array(column) ** 2 for column in zip(*members, strict=True))
    covariance = np.zeros((K, M, d, d))
    covariance[..., LEVEL, LEVEL] = _UNKNOWN
    covariance[..., SLOPE, SLOPE] = start
    free = np.arange(COVARIATES, d)
    covariance[..., free, free] = _UNKNOWN if prior_sigmas is None else np.minimum(prior_sigmas**2, _UNKNOWN)
    noise = np.broadcast_to(np.stack([level, wander], axis=1), (K, M, 2))
    new = {"mean": np.zeros((K, M, d)), "covariance": covariance, "squares": np.zeros((K, M)), "count": np.zeros(K)}
    new |= {"log_likelihood": np.zeros((K, M)), "noise": noise, "origin": values, "unit": sigmas}
    return Bank(**{name: np.concatenate([own, new[name]]) for name, own in vars(bank).items()})


def reset_moved(bank: Bank, moved: Mask) -> Bank:
    """The bank after something happened to some parameters (P,): their levels and slopes are open again."""
    covariance = bank.covariance.copy()
    covariance[moved, :, LEVEL, LEVEL] += _UNKNOWN
    covariance[moved, :, SLOPE, SLOPE] += 1.0
    return replace(bank, covariance=covariance)


def predicted_bank(bank: Bank, days: float) -> Bank:
    """The bank some days later, with nothing measured since."""
    F = transition(bank.mean.shape[2], days)
    covariance = F @ bank.covariance @ F.T
    level, slope = bank.noise[..., 0] * days, bank.noise[..., 1]
    covariance[..., LEVEL, LEVEL] += level + slope * days**3 / 3
    covariance[..., SLOPE, SLOPE] += slope * days
    covariance[..., LEVEL, SLOPE] += slope * days**2 / 2
    covariance[..., SLOPE, LEVEL] += slope * days**2 / 2
    return replace(bank, mean=bank.mean @ F.T, covariance=covariance)


def transition(d: int, days: float) -> Array:
    """(d, d) the level goes on along the slope."""
    F = np.eye(d)
    F[LEVEL, SLOPE] = days
    return F


def updated_bank(bank: Bank, values: Array, sigmas: Array, covariates: Array) -> tuple[Bank, Array]:
    """One session more.

    Args:
        bank: predicted to the time of the session.
        values: (P,) NaN where the session does not show a parameter.
        sigmas: (P,) as the run states them.
        covariates: (d − 2,) less those of the first session.

    Returns:
        The bank, and the innovations of member 0 as standard normal numbers (P,); NaN where nothing can be said yet.
    """
    seen = np.isfinite(values) & np.isfinite(sigmas) & (sigmas > 0)
    x = np.concatenate([[1.0, 0.0], covariates])
    y = np.where(seen, (values - bank.origin) / bank.unit, 0.0)[:, None]
    R = np.where(seen, (sigmas / bank.unit) ** 2, 1.0)[:, None]
    carried = bank.covariance @ x  # (P, M, d)
    F = carried @ x + R
    e = y - bank.mean @ x
    told = (seen[:, None] & (F < _START_VARIANCES * R))[:, :1]
    freedom, spread = bank.count + _STATED, np.sqrt(F * bank.scatter)
    e_calm = np.clip(e, -WILD * spread, WILD * spread)
    gain = np.where(seen[:, None], 1.0, 0.0)[..., None] * carried / F[..., None]
    covariance = bank.covariance - gain[..., None] * carried[..., None, :]
    after = replace(
        bank,
        mean=bank.mean + gain * e_calm[..., None],
        covariance=(covariance + np.swapaxes(covariance, -1, -2)) / 2,
        squares=bank.squares + np.where(told, e_calm**2 / F, 0.0),
        count=bank.count + told[:, 0],
        log_likelihood=bank.log_likelihood + np.where(told, student_log_density(e_calm, spread, freedom[:, None]), 0.0),
    )
    return after, normal_equivalent(np.where(told, e / spread, np.nan)[:, 0], freedom)


# Control charts on innovations in sigmas: two CUSUMs and an EWMA a parameter, each to both sides.
#
# The CUSUM of reference value 2 waits for a step (two sessions of 3.6 sigmas), that of 0.25 and the EWMA of weight 0.05
# for what moves slowly (Page 1954, Biometrika 41:100; Roberts 1959, Technometrics 1:239; the three together as in Lucas
# & Saccucci 1990, Technometrics 32:1). Innovations count as four sigmas at most: one wild session is no alarm, two may
# be.

CUSUM_REFERENCES = (0.25, 2.0)
EWMA_WEIGHT = 0.05
CHART_NAMES = ("CUSUM 0.25", "CUSUM 2", "EWMA 0.05")
# Beside the charts: odds of a slope since the first session, for what moves from the beginning on, when no chart has
# seen the parameter still. With this probability a cell ever alarms falsely by them.
ODDS = "odds of a slope"
_EVER = 0.0025


@dataclass(frozen=True)
class Charts:
    """Of P parameters."""

    cusums: Array  # (P, 2, 2) by reference value, upwards and downwards
    ewma: Array  # (P,)


def empty_charts(parameters: int) -> Charts:
    """Charts that begin."""
    return Charts(np.zeros((parameters, len(CUSUM_REFERENCES), 2)), np.zeros(parameters))


def updated_charts(charts: Charts, innovations: Array) -> Charts:
    """One session more; innovations (P,), NaN where there is none."""
    seen = np.isfinite(innovations)
    u = np.clip(np.where(seen, innovations, 0.0), -WILD, WILD)
    signed = u[:, None, None] * np.array([1.0, -1.0])
    cusums = np.maximum(charts.cusums + signed - np.array(CUSUM_REFERENCES)[:, None], 0.0)
    ewma = (1 - EWMA_WEIGHT) * charts.ewma + EWMA_WEIGHT * u
    return Charts(np.where(seen[:, None, None], cusums, charts.cusums), np.where(seen, ewma, charts.ewma))


def restarted(charts: Charts, moved: Mask) -> Charts:
    """The charts with those of some parameters (P,) at zero."""
    return replace(
        charts, cusums=np.where(moved[:, None, None], 0.0, charts.cusums), ewma=np.where(moved, 0.0, charts.ewma)
    )


@cache
def chart_limits(sessions: float, parameters: int) -> tuple[float, ...]:
    """Limit of each chart of `NAMES` so that the whole cell alarms falsely once in so many sessions.

    The rate is split evenly over charts and parameters: were they independent, rates would add up; as the charts of one
    parameter go together, the cell's rate is smaller.
    """
    own = sessions * parameters * len(CHART_NAMES)
    return (*(cusum_limit(k, own) for k in CUSUM_REFERENCES), ewma_limit(EWMA_WEIGHT, own))


def odds_limit(parameters: int) -> float:
    """Log odds of a slope from which on a parameter alarms."""
    return float(np.log(max(parameters, 1) / _EVER))


def limit_shares(charts: Charts, limit: tuple[float, ...]) -> Array:
    """(P, 3) each chart as a share of its limit; an alarm from 1 on."""
    return np.column_stack([*(charts.cusums.max(axis=2) / np.array(limit[:-1])).T, np.abs(charts.ewma) / limit[-1]])


# Whether a parameter has moved steadily since its first session: what no chart can tell that never saw it still.

# The members that believe that nothing moves, and in a steady slope.
STILL, STEADY = 0, 5


def slope_odds(bank: Bank, still: int = STILL, steady: int = STEADY) -> Array:
    """(P,) log odds of a steady slope since the first session over no motion; −inf after something has happened.

    Where nothing moves they exceed log(1/α) with probability α at most, however long one watches (Ville's inequality).
    """
    untouched = bank.covariance[:, still, SLOPE, SLOPE] == 0
    return np.where(untouched, bank.log_likelihood[:, steady] - bank.log_likelihood[:, still], -np.inf)


# When something began to move, and how: by the shape that takes most out of what is left of a parameter.
#
# Generalised likelihood ratio over the session of onset and the shape (Basseville & Nikiforov 1993, Detection of Abrupt
# Changes, 2.4): a step (the mount was knocked), a line in time (something wears), or a response to a channel that began
# (a joint that has become soft follows the temperature).

# Sessions that are looked back; before them the onset is not sought.
LONGEST = 600
# Sessions for each number that an undisturbed parameter is told by.
_FEW = 3
# Sessions after an onset from which a line, or a response to a channel, can be told from a step.
_COURSE = 6
# Share of a column that must be left beside the columns of the undisturbed parameter.
_MIN_COLUMN_SHARE = 1e-6


@dataclass(frozen=True)
class Onset:
    """The likeliest beginning of a change."""

    session: int  # of those given, the first that has moved
    shape: str  # step | drift | name of a channel
    size: float  # of the step; per day; per unit of the channel
    sigma: float
    p_value: float  # of the best of all that were tried, Bonferroni


def find_onset(values: Array, sigmas: Array, days: Array, covariates: Array, channels: Sequence[str]) -> Onset | None:
    """The onset in n sessions; None where there are too few to say.

    Args:
        values: (n,) with their sigmas (n,), as stated.
        days: (n,) times.
        covariates: (n, c) what the undisturbed parameter follows; the first belong to `channels`.
    """
    seen = np.flatnonzero(np.isfinite(values) & np.isfinite(sigmas) & (sigmas > 0))[-LONGEST:]
    n = len(seen)
    # What a few sessions follow cannot be told.
    follows = covariates[seen] if n >= _FEW * (1 + covariates.shape[1]) else np.zeros((n, 0))
    base, _ = np.linalg.qr(_varying_columns(np.column_stack([np.ones(n), follows])) / sigmas[seen, None])
    if n < base.shape[1] + 2:
        return None
    y: Array = _without_base(base, (values[seen] / sigmas[seen])[:, None])[:, 0]
    best, tried, square = (0.0, "", 0, 0.0), 0, float(y @ y)
    for shape, columns in _change_shapes(days[seen], covariates[seen], channels).items():
        white = columns / sigmas[seen, None]
        left = _without_base(base, white)
        length = np.sum(left**2, axis=0)
        told = length > _MIN_COLUMN_SHARE * np.maximum(np.sum(white**2, axis=0), 1e-300)
        gains = np.where(told, (y @ left) ** 2 / np.where(told, length, 1.0), 0.0)
        tried += int(told.sum())
        at = int(np.argmax(gains))
        if gains[at] > best[0]:
            best = (float(gains[at]), shape, at, float(y @ left[:, at] / length[at]))
    gain, shape, at, size = best
    freedom = n - base.shape[1] - 1
    if not shape or freedom < 1:
        return None
    t = np.sqrt(gain / max((square - gain) / freedom, 1e-12 * square))
    p_value = min(1.0, tried * 2 * float(stdtr(freedom, -t)))
    return Onset(int(seen[at]), shape, size, abs(size) / float(t), p_value)


def _change_shapes(days: Array, covariates: Array, channels: Sequence[str]) -> dict[str, Array]:
    """(n, n) columns by shape: in column k what begins at session k, per day and per unit of the channel."""
    after = np.tri(len(days)).astype(float)
    out, long = {"step": after}, after.copy()
    long[:, -_COURSE:] = 0.0
    out["drift"] = long * (days[:, None] - days[None, :])
    for c, name in enumerate(channels):
        out[name] = long * (covariates[:, c, None] - covariates[None, :, c])
    return out


def _varying_columns(columns: Array) -> Array:
    """Without columns that hardly change: they would be taken for the constant."""
    spread = np.ptp(columns, axis=0)
    return columns[:, (spread > 1e-9 * np.abs(columns).max(axis=0)) | (np.arange(columns.shape[1]) == 0)]


def _without_base(base: Array, columns: Array) -> Array:
    return np.asarray(columns - base @ (base.T @ columns))


# Session after session: the bank goes on, the charts watch its innovations, and what alarms is followed anew.
#
# An alarm names an onset in the past. From there on level and slope of the parameter are open again and its charts
# begin at zero, so that a second event after a first is seen as well. To go back costs the sessions since the onset;
# states are kept at intervals for that.


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
        bank = with_parameters(bank, *_first_values(sessions, known), sessions.prior_sigmas)
        more = empty_charts(len(values) - known)
        charts = Charts(np.concatenate([charts.cusums, more.cusums]), np.concatenate([charts.ewma, more.ewma]))
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


# Where every parameter was, seen from now: the fixed-interval smoother of the likeliest member of the bank.
#
# Rauch, Tung & Striebel (1965, AIAA J. 3:1445). Backwards from the last session it needs the filtered states of as many
# sessions as are shown, and no others.

# Directions of a predicted covariance below this share of its largest are not known to move.
_SINGULAR = 1e-13


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
        own = state.bank
        filtered.append(own.chosen(members[: len(own.origin)]))
    return _smooth_backwards(filtered, sessions, moved, last.bank.chosen(members))


def _smooth_backwards(
    filtered: Sequence[Bank], sessions: Sessions, moved: Mapping[int, Sequence[int]], last: Bank
) -> tuple[Array, Array]:
    n, P, d = len(filtered), len(last.origin), last.mean.shape[2]
    means, covariances = np.full((n, P, d), np.nan), np.full((n, P, d, d), np.nan)
    mean, covariance = filtered[-1].mean[:, 0], filtered[-1].covariance[:, 0]
    means[-1], covariances[-1] = mean, covariance
    for k in range(n - 2, -1, -1):
        now, known = filtered[k], len(filtered[k].origin)
        days = sessions.days[k + 1] - sessions.days[k]
        ahead = predicted_bank(now, max(days, 0.0))
        if happened := moved.get(sessions.ids[k + 1], ()):
            ahead = reset_moved(ahead, np.isin(np.arange(known), list(happened)))
        F = transition(d, max(days, 0.0))
        P_ahead = ahead.covariance[:, 0]
        gain = now.covariance[:, 0] @ F.T @ _inverse(P_ahead)
        mean = now.mean[:, 0] + np.einsum("pij,pj->pi", gain, mean[:known] - ahead.mean[:, 0])
        covariance = now.covariance[:, 0] + gain @ (covariance[:known] - P_ahead) @ np.swapaxes(gain, -1, -2)
        means[k, :known], covariances[k, :known] = mean, covariance
    x = np.column_stack([np.ones(n), np.zeros(n), sessions.covariates])
    variance = np.einsum("ni,npij,nj->np", x, covariances, x) * last.scatter[:, 0]
    values = last.origin + last.unit * np.einsum("npi,ni->np", means, x)
    return values, last.unit * np.sqrt(np.maximum(variance, 0.0))


def _inverse(covariance: Array) -> Array:
    """(P, d, d) of symmetric matrices of which some directions may be certain: these stay as they are."""
    diagonal = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    scale = np.where(diagonal > 0, 1 / np.where(diagonal > 0, diagonal, 1.0), 0.0)
    unit = covariance * scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.pinv(unit, rcond=_SINGULAR, hermitian=True) * scale[:, :, None] * scale[:, None, :])
