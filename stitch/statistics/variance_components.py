"""Variance components by restricted maximum likelihood, with or without a prior on some columns of the mean.

What is maximised stands in `restricted_likelihood.py`.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import minimize

from stitch.frames import Array
from stitch.statistics.restricted_likelihood import (
    Likelihood,
    MixedModel,
    RemlProblem,
    deviance,
    likelihood,
    reml_problem,
)
from stitch.statistics.variance_prior import NOISE, usual_variances
from stitch.statistics.variance_scoring import fisher_scoring

_SPAN = (32.0, 14.0)  # the search, in log variance below and above the start
_ABSENT = 1e-300  # in place of a variance of zero, which has no logarithm
_FACTORS = (float(np.log(0.3)), float(np.log(1e8)))  # and of the factor on the noise
# The search ends where the deviance's slope is below the first; with thousands of numbers below the second: the
# curvature grows with their count, and 0.1 then costs the deviance less than 1e-5.
# Where further components may be absent, begun near the maximum, the third: their prior alone curves by 0.09, so that
# the deviance is missed by less than slope²/(2·0.09), 0.005.
_FLAT, _FLAT_AMONG_MANY, _FLAT_NEAR_MAXIMUM, MANY_NUMBERS = 1e-4, 0.1, 0.03, 1_000


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
    problem = reml_problem(mixed, G, prior)
    guess = usual_variances(mixed.z, mixed.components) if start is None else start
    first = np.log(np.maximum(guess, _ABSENT))
    scattered = np.arange(len(first)) != NOISE
    begin = [first, first - 9.0 * scattered] if both_starts else [first]
    centre = np.log(usual_variances(mixed.z, mixed.components))
    few = _FLAT if start is None or mixed.further is None else _FLAT_NEAR_MAXIMUM
    flat = _FLAT_AMONG_MANY if mixed.size > MANY_NUMBERS else few
    bounds = [(c - _SPAN[0], c + _SPAN[1]) if s else _FACTORS for c, s in zip(centre, scattered, strict=True)]
    present = np.einsum("cbii->c", mixed.components) > 0
    bounds = [own if there else (np.log(_ABSENT),) * 2 for own, there in zip(bounds, present, strict=True)]
    options = {"ftol": 1e-9, "gtol": flat, "maxiter": 60}
    # Scoring has no bounds: begun within them, it would go once more where an earlier fit has ended beyond.
    near = [fisher_scoring(problem, s, flat) if present.all() else None for s in begin]
    begin = [np.clip(s, *np.array(bounds).T) for s in begin]
    search = partial(minimize, deviance, args=(problem,), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    fits = [
        _fit_at(problem, np.where(present, np.exp(search(s).x), 0.0))
        if found is None
        else _as_variance_fit(np.exp(found[0]), found[1])
        for s, found in zip(begin, near, strict=True)
    ]
    return min(fits, key=lambda fit: fit.deviance)


def at_variances(
    mixed: MixedModel, variances: Array, G: Array | None = None, prior: Array | None = None
) -> VarianceFit:
    """The same without searching: mean, covariance and deviance for given variances (c,)."""
    return _fit_at(reml_problem(mixed, G, prior), np.asarray(variances))


def _fit_at(problem: RemlProblem, variances: Array) -> VarianceFit:
    return _as_variance_fit(variances, likelihood(np.log(np.maximum(variances, _ABSENT)), problem))


def _as_variance_fit(variances: Array, solution: Likelihood) -> VarianceFit:
    return VarianceFit(variances, solution.deviance, solution.mean, solution.covariance)


def whitener(mixed: MixedModel, variances: Array) -> Array:
    """(B, m, m) inverse Cholesky factors of the blocks' covariance."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(mixed.covariance(variances))))
