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

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln, ndtri, stdtr

from stitch.numerics.frames import Array, Indices, Mask

# Places of a member's numbers.
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
_UNKNOWN = 1e8
_START_VARIANCES = 1e5
# A session farther off than so many sigmas counts as so many: one wild session must not carry the level away.
WILD = 4.0
# Degrees of freedom that the stated sigmas are worth: few, for they may be twice too small; enough that a jump of a
# hundred sigmas between the first sessions is no scatter.
_STATED = 2.0
# The members that believe that nothing moves, and in a steady slope.
STILL, STEADY = 0, 5
# Beside the charts: odds of a slope since the first session, for what moves from the beginning on, when no chart has
# seen the parameter still. With this probability a cell ever alarms falsely by them.
ODDS = "odds of a slope"
_EVER = 0.0025


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
        return (self.squares + _STATED) / (self.count + _STATED)[:, None]

    @property
    def best(self) -> Indices:
        """(P,) member by which the sessions so far were likeliest."""
        return np.argmax(self.log_likelihood, axis=1)

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
    return Bank(**{name: np.concatenate([known, new[name]]) for name, known in vars(bank).items()})


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
    is_shown = np.isfinite(values) & np.isfinite(sigmas) & (sigmas > 0)
    x = np.concatenate([[1.0, 0.0], covariates])
    y = np.where(is_shown, (values - bank.origin) / bank.unit, 0.0)[:, None]
    R = np.where(is_shown, (sigmas / bank.unit) ** 2, 1.0)[:, None]
    carried = bank.covariance @ x  # (P, M, d)
    F = carried @ x + R
    e = y - bank.mean @ x
    tells_scatter = (is_shown[:, None] & (F < _START_VARIANCES * R))[:, :1]
    freedom = bank.count + _STATED
    spread = np.sqrt(F * bank.scatter)
    e_calm = np.clip(e, -WILD * spread, WILD * spread)
    gain = np.where(is_shown[:, None], 1.0, 0.0)[..., None] * carried / F[..., None]
    covariance = bank.covariance - gain[..., None] * carried[..., None, :]
    density = student_log_density(e_calm, spread, freedom[:, None])
    after = replace(
        bank,
        mean=bank.mean + gain * e_calm[..., None],
        covariance=(covariance + np.swapaxes(covariance, -1, -2)) / 2,
        squares=bank.squares + np.where(tells_scatter, e_calm**2 / F, 0.0),
        count=bank.count + tells_scatter[:, 0],
        log_likelihood=bank.log_likelihood + np.where(tells_scatter, density, 0.0),
    )
    return after, normal_equivalent(np.where(tells_scatter, e / spread, np.nan)[:, 0], freedom)


def slope_odds(bank: Bank, still: int = STILL, steady: int = STEADY) -> Array:
    """(P,) log odds of a steady slope since the first session over no motion; −inf after something has happened.

    Where nothing moves they exceed log(1/α) with probability α at most, however long one watches (Ville's inequality).
    """
    untouched = bank.covariance[:, still, SLOPE, SLOPE] == 0
    return np.where(untouched, bank.log_likelihood[:, steady] - bank.log_likelihood[:, still], -np.inf)


def odds_limit(parameters: int) -> float:
    """Log odds of a slope from which on a parameter alarms."""
    return float(np.log(max(parameters, 1) / _EVER))


def transition(d: int, days: float) -> Array:
    """(d, d) the level goes on along the slope."""
    F = np.eye(d)
    F[LEVEL, SLOPE] = days
    return F


def student_log_density(e: Array, spread: Array, freedom: Array) -> Array:
    """(...,) log density of t = e/spread as one of e, up to a constant; `freedom` are the degrees of freedom."""
    constant = gammaln((freedom + 1) / 2) - gammaln(freedom / 2) - np.log(freedom) / 2 - np.log(spread)
    return constant - (freedom + 1) / 2 * np.log1p((e / spread) ** 2 / freedom)


def normal_equivalent(t: Array, freedom: Array) -> Array:
    """(...,) numbers of Student's t as normal numbers of the same probability."""
    return -np.sign(t) * ndtri(np.maximum(stdtr(freedom, -np.abs(t)), 1e-300))
