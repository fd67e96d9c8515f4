"""Variance components by restricted maximum likelihood, with or without a prior on some columns of the mean.

    z = A·α + G·θ + noise,   cov(noise) = V = Σ_i λ_i C_i,   θ ~ N(0, S)

The α are free (integrated out with a flat prior: that is REML, Patterson & Thompson 1971, Harville 1977);
the θ have a prior of the size that is plausible (their integral is the evidence for the columns G). V is
block-diagonal in B blocks: one for the pose channel of scans, one a view for labelled points.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import minimize

from stitch.frames import Array
from stitch.statistics.inverse import inverted
from stitch.statistics.variance_prior import NOISE, log_prior, prior_information, usual_variances

_SPAN = (32.0, 14.0)  # the search, in log variance below and above the start
_ABSENT = 1e-300  # in place of a variance of zero, which has no logarithm
_FACTORS = (float(np.log(0.3)), float(np.log(1e8)))  # and of the factor on the noise
# The search ends where the deviance's slope is below the first; with thousands of numbers below the second: the
# curvature grows with their count, and 0.1 then costs the deviance less than 1e-5.
# Where further components may be absent, begun near the maximum, the third: their prior alone curves by 0.09, so that
# the deviance is missed by less than slope²/(2·0.09), 0.005.
_FLAT, _FLAT_AMONG_MANY, _FLAT_BEGUN, MANY_NUMBERS = 1e-4, 0.1, 0.03, 1_000
# Scoring steps, their largest leap in a log variance, how often one is halved, the deviance that is not worth another
# (rounding alone moves that of thousands of numbers by a tenth of it), and the blocks from which they pay.
_SCORINGS, _LEAP, _HALVINGS, _SETTLED, _MANY_BLOCKS = 10, 2.0, 4, 1e-3, 50


@dataclass(frozen=True)
class MixedModel:
    """B blocks of m numbers that were seen, the columns of their mean and the components of their covariance."""

    z: Array  # (B, m)
    A: Array  # (B, m, a) columns of the free mean
    components: (
        Array  # (c, B, m, m) of unit rotation scatter, translation scatter, sensor noise, and what there is more
    )
    fixed: Array | None = None  # (B, m, m) what is known of the covariance, and 1 on the diagonal of absent numbers
    independent: int | None = None  # numbers that could err independently, if that is not all of them
    scales: Array | None = None  # (c − 3,) that σ of the further components usually has; None: there are none

    @property
    def size(self) -> int:
        """Numbers in all."""
        return int(self.z.size) if self.independent is None else self.independent

    def covariance(self, variances: Array) -> Array:
        """(B, m, m) for variances (c,)."""
        V = np.einsum("c,cbij->bij", variances, self.components)
        return np.asarray(V if self.fixed is None else V + self.fixed)


@dataclass(frozen=True)
class VarianceFit:
    """The maximum: variances λ (c,), −2 log of the (restricted) likelihood, and the mean's coefficients."""

    variances: Array  # (c,)
    deviance: float
    mean: Array  # (a + g,)
    covariance: Array  # (a + g, a + g)


def fit_variances(
    mixed: MixedModel,
    G: Array | None = None,
    prior: Array | None = None,
    start: Array | None = None,
    both_starts: bool = False,
) -> VarianceFit:
    """Maximise over the variances.

    Args:
        G: (B, m, g) further columns of the mean.
        prior: (g,) standard deviations of their coefficients; None leaves them free.
        start: (c,) variances to begin with; None starts from the spread of z.
        both_starts: also begin from noise alone, where the likelihood may have a second maximum.

    Returns:
        A component that no number has is at variance zero.
    """
    problem = _problem(mixed, G, prior)
    guess = usual_variances(mixed.z, mixed.components) if start is None else start
    first = np.log(np.maximum(guess, _ABSENT))
    scattered = np.arange(len(first)) != NOISE
    begin = [first, first - 9.0 * scattered] if both_starts else [first]
    centre = np.log(usual_variances(mixed.z, mixed.components))
    few = _FLAT if start is None or mixed.scales is None else _FLAT_BEGUN
    flat = _FLAT_AMONG_MANY if mixed.size > MANY_NUMBERS else few
    bounds = [(c - _SPAN[0], c + _SPAN[1]) if s else _FACTORS for c, s in zip(centre, scattered, strict=True)]
    present = np.einsum("cbii->c", mixed.components) > 0
    bounds = [own if there else (np.log(_ABSENT),) * 2 for own, there in zip(bounds, present, strict=True)]
    options = {"ftol": 1e-9, "gtol": flat, "maxiter": 60}
    begin = [np.clip(s, *np.array(bounds).T) for s in begin]
    near = _scored(problem, begin[0], flat) if len(begin) == 1 and present.all() else None
    if near is not None:
        return at_variances(mixed, np.exp(near), G, prior)
    search = partial(minimize, _deviance, args=(problem,), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    best = min((search(s) for s in begin), key=lambda f: float(f.fun))
    return at_variances(mixed, np.where(present, np.exp(best.x), 0.0), G, prior)


def _scored(problem: "_Problem", begin: Array, flat: float) -> Array | None:
    """(c,) log variances at the maximum by Fisher scoring, where it lies near; None where a search must look for it.

    The expected curvature of the deviance is λ_iλ_j tr(V⁻¹C_iV⁻¹C_j), less what the mean takes. With thousands of
    numbers in small blocks three steps do what a search without curvature needs sixteen for.
    """
    mixed = problem.mixed
    if mixed.scales is not None or len(mixed.z) < _MANY_BLOCKS:
        return None
    x, (value, slope) = begin, _deviance(begin, problem)
    for _ in range(_SCORINGS):
        if np.abs(slope).max() < flat:
            return x
        variances = np.exp(x)
        inverse, _ = inverted(mixed.covariance(variances))
        shares = variances[:, None, None, None] * (inverse @ mixed.components)
        curvature = np.einsum("cbij,dbji->cd", shares, shares, optimize=True)
        # In the log of a variance that is hardly seen the likelihood curves by its slope.
        curvature += np.diag(2 * prior_information(variances, None) + np.maximum(slope - log_prior(x, None)[1], 0.0))
        step = -np.linalg.solve(curvature, slope)
        if -0.5 * float(slope @ step) < _SETTLED:
            return x
        step *= min(1.0, _LEAP / float(np.abs(step).max()))
        for _ in range(_HALVINGS):
            lower, its_slope = _deviance(x + step, problem)
            if lower <= value + _SETTLED:
                break
            step /= 2
        else:
            return None
        x, value, slope = x + step, lower, its_slope
    return None


def at_variances(
    mixed: MixedModel, variances: Array, G: Array | None = None, prior: Array | None = None
) -> VarianceFit:
    """The same without searching: mean, covariance and deviance for given variances (c,)."""
    problem = _problem(mixed, G, prior)
    deviance, _ = _deviance(np.log(np.maximum(variances, _ABSENT)), problem)
    V, X = mixed.covariance(variances), problem.X
    weighted = np.linalg.solve(V, np.concatenate([X, mixed.z[..., None]], axis=2))
    M = _summed(X, weighted[..., :-1]) + np.diag(problem.precision)
    # Equilibrate: columns count in rad, mm and per hour.
    scale = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    covariance = np.linalg.pinv(M * scale[:, None] * scale, rcond=1e-13, hermitian=True) * scale[:, None] * scale
    mean = covariance @ _summed(X, weighted[..., -1:])[:, 0]
    return VarianceFit(np.asarray(variances), deviance, mean, covariance)


def whitener(mixed: MixedModel, variances: Array) -> Array:
    """(B, m, m) inverse Cholesky factors of the blocks' covariance."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(mixed.covariance(variances))))


def deviance_slope(log_variances: Array, mixed: MixedModel) -> tuple[float, Array]:
    """−2 log of restricted likelihood and prior of the log variances (c,), up to a constant, and its slope (c,)."""
    return _deviance(log_variances, _problem(mixed, None, None))


@dataclass(frozen=True)
class _Problem:
    mixed: MixedModel
    X: Array  # (B, m, a + g)
    precision: Array  # (a + g,) of the prior
    offset: float  # log det of the prior covariance


def _problem(mixed: MixedModel, G: Array | None, prior: Array | None) -> _Problem:
    a = mixed.A.shape[2]
    if G is None:
        return _Problem(mixed, mixed.A, np.zeros(a), 0.0)
    X = np.concatenate([mixed.A, G], axis=2)
    if prior is None:
        return _Problem(mixed, X, np.zeros(X.shape[2]), 0.0)
    precision = np.concatenate([np.zeros(a), 1 / prior**2])
    return _Problem(mixed, X, precision, float(2 * np.log(prior).sum()))


def _deviance(log_variances: Array, problem: _Problem) -> tuple[float, Array]:
    """−2 log restricted likelihood and its slope in the log variances."""
    with np.errstate(over="ignore"):
        mixed, variances = problem.mixed, np.exp(log_variances)
    inverse, logdet = inverted(mixed.covariance(variances))
    if not np.isfinite(logdet):
        return 1e300, np.zeros(len(variances))
    WX = inverse @ problem.X
    M = _summed(problem.X, WX) + np.diag(problem.precision)
    scale = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    values, vectors = np.linalg.eigh(M * scale[:, None] * scale[None, :])
    keep = values > 1e-12
    half = (scale[:, None] * vectors[:, keep]) / np.sqrt(values[keep])
    b = _rows(WX).T @ mixed.z.ravel()
    beta = half @ (half.T @ b)
    rest = mixed.z - problem.X @ beta
    Wr = np.matmul(inverse, rest[..., None])
    WXh = WX @ half
    # d/dλ_i = tr(P C_i) − rᵀWC_iWr with P = W − WX M⁻¹ XᵀW: one matrix against every component.
    against = inverse - WXh @ WXh.transpose(0, 2, 1) - Wr @ Wr.transpose(0, 2, 1)
    slope = variances * (mixed.components.reshape(len(variances), -1) @ against.ravel())
    # zᵀP z with P = (V + G S Gᵀ)⁻¹ projected: (z − Xβ)ᵀV⁻¹(z − Xβ) + βᵀQβ.
    square = float(rest.ravel() @ Wr.ravel()) + float(beta @ (problem.precision * beta))
    logdet += float(np.log(values[keep]).sum() - 2 * np.log(scale).sum()) + problem.offset
    believed, pull = log_prior(log_variances, mixed.scales)
    return logdet + square + believed, slope + pull


def _summed(X: Array, Y: Array) -> Array:
    """Σ_b XᵀY, (a, c)."""
    return np.asarray(_rows(X).T @ _rows(Y))


def _rows(X: Array) -> Array:
    """(B·m, a) of (B, m, a); a model that is only judged has no columns."""
    return X.reshape(X.shape[0] * X.shape[1], X.shape[2])
