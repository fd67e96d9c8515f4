"""The mean of a mixed model with the uncertainty of its variances: a mixture over variances, not a plug-in.

With few views a variance may well be zero at its maximum, and every sigma after it a lie. So the coefficients of
the mean are averaged over the variances' posterior (REML likelihood times prior), drawn by Hamiltonian Monte Carlo
(Duane et al. 1987; Neal 2011) about the maximum, with the same random numbers every time.
"""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.statistics.least_squares import generalised
from stitch.statistics.variance_components import MixedModel, VarianceFit, deviance_slope

# Draws that count and those before them; leapfrog steps of a draw and their length, in standard deviations.
_DRAWS, _BURNT = 48, 8
# Among so many numbers the variances are known better, and a draw takes longer: fewer do. Among as many as the second
# number the maximum alone must do.
_AMONG, _NO_DRAWS = 300, 1_200
_LEAPS, _LEAP = 5, (0.35, 0.75)
_STEP = 0.05  # of log variances, for the slope's slope
# What log variances are believed to spread by, where the curvature at the maximum says otherwise.
_SHARPEST, _WIDEST = 0.1, 4.0


@dataclass(frozen=True)
class MeanPosterior:
    """Coefficients of the mean over all variances that the numbers allow."""

    mean: Array  # (a,)
    covariance: Array  # (a, a)
    contributions: Array  # (c, a, a) of the components to the covariance; the rest is how little variances are known
    variances: Array  # (c,) geometric means
    accepted: float  # share of the draws


def mean_posterior(mixed: MixedModel, fit: VarianceFit, columns: Array, prior: tuple[Array, Array]) -> MeanPosterior:
    """Average over the variances about their maximum.

    Args:
        mixed: one block; its A spans the same mean as the columns.
        fit: the maximum.
        columns: (m, a) of the mean, in the units of the coefficients.
        prior: precision (a, a) of the coefficients, and that times its middle (a,).
    """
    centre = np.log(np.maximum(fit.variances, 1e-300))
    draws, accepted = _drawn(mixed, centre) if mixed.size < _NO_DRAWS else (centre[None], 1.0)
    found = [_solved(mixed, np.exp(draw), columns, prior) for draw in draws]
    means = np.array([f[0] for f in found])
    apart = means - means.mean(axis=0)
    return MeanPosterior(
        mean=means.mean(axis=0),
        covariance=np.mean([f[2] for f in found], axis=0) + apart.T @ apart / len(apart),
        contributions=np.mean([f[1] for f in found], axis=0),
        variances=np.exp(np.mean(draws, axis=0)),
        accepted=accepted,
    )


def _drawn(mixed: MixedModel, centre: Array) -> tuple[Array, float]:
    """(K, c) log variances of the posterior, begun at its maximum, and the share of accepted draws."""
    spread = _spread(mixed, centre)
    rng = np.random.default_rng(0)
    here, (deviance, slope) = centre, deviance_slope(centre, mixed)
    out, accepted = [], 0
    wanted = int(np.clip(_DRAWS * (_AMONG / mixed.size) ** 2, _BURNT, _DRAWS))
    for _ in range(_BURNT + wanted):
        momentum = rng.standard_normal(len(centre))
        leap, energy = rng.uniform(*_LEAP), 0.5 * deviance + 0.5 * momentum @ momentum
        there, next_deviance, next_slope = here, deviance, slope
        for _ in range(_LEAPS):
            momentum = momentum - 0.5 * leap * spread.T @ (0.5 * next_slope)
            there = there + leap * spread @ momentum
            next_deviance, next_slope = deviance_slope(there, mixed)
            momentum = momentum - 0.5 * leap * spread.T @ (0.5 * next_slope)
        if np.log(rng.uniform()) < energy - 0.5 * next_deviance - 0.5 * momentum @ momentum:
            here, deviance, slope, accepted = there, next_deviance, next_slope, accepted + 1
        out.append(here)
    return np.array(out[_BURNT:]), accepted / len(out)


def _spread(mixed: MixedModel, centre: Array) -> Array:
    """(c, c) square root of the covariance that the curvature at the maximum gives the log variances."""
    steps = _STEP * np.eye(len(centre))
    curvature = np.array([deviance_slope(centre + s, mixed)[1] - deviance_slope(centre - s, mixed)[1] for s in steps])
    values, vectors = np.linalg.eigh((curvature + curvature.T) / (8 * _STEP))
    return np.asarray(vectors / np.sqrt(np.clip(values, _WIDEST**-2, _SHARPEST**-2)))


def _solved(mixed: MixedModel, variances: Array, columns: Array, prior: tuple[Array, Array]) -> tuple[Array, ...]:
    """Coefficients (a,), the components' contributions (c, a, a) and the covariance (a, a) at given variances."""
    own = generalised(mixed.covariance(variances)[0], columns, prior[0])
    shares = [v * own.gain @ C[0] @ own.gain.T for v, C in zip(variances, mixed.components, strict=True)]
    return own.solve(mixed.z[0], prior[1]), np.array(shares), own.covariance
