"""Variances with their uncertainty: averaged over their posterior, not plugged in at its maximum.

With few views a variance may well be zero at its maximum, and every sigma after it a lie. A covariance is linear in its
variances, so what counts is their posterior mean (REML likelihood times prior), drawn by Hamiltonian Monte Carlo
(Duane et al. 1987, Phys. Lett. B 195:216; Neal 2011) about the maximum, with the same random numbers every time.
"""

import numpy as np

from stitch.frames import Array
from stitch.statistics.restricted_likelihood import MixedModel, deviance_slope
from stitch.statistics.variance_components import VarianceFit

# Draws that count and those before them; leapfrog steps of a draw and their length, in standard deviations.
_DRAWS, _BURNT = 48, 8
# Among so many numbers the variances are known better, and a draw takes longer: fewer do. Among as many as the second
# number the maximum alone must do.
_AMONG, _NO_DRAWS = 300, 1_200
_LEAPS, _LEAP = 5, (0.35, 0.75)
_STEP = 0.05  # of log variances, for the slope's slope
# What log variances are believed to spread by, where the curvature at the maximum says otherwise.
_SHARPEST, _WIDEST = 0.1, 4.0


def mean_variances(mixed: MixedModel, fit: VarianceFit) -> Array:
    """(c,) posterior means of the variances, begun at their maximum.

    Among so many numbers that a draw takes seconds, the maximum itself.
    """
    if mixed.size >= _NO_DRAWS:
        return fit.variances
    return np.asarray(np.exp(_drawn(mixed, np.log(np.maximum(fit.variances, 1e-300)))).mean(axis=0))


def _drawn(mixed: MixedModel, centre: Array) -> Array:
    """(K, c) log variances of the posterior, begun at its maximum."""
    spread = _spread(mixed, centre)
    rng = np.random.default_rng(0)
    here, (deviance, slope) = centre, deviance_slope(centre, mixed)
    out = []
    wanted = int(np.clip(_DRAWS * (_AMONG / mixed.size) ** 3, _BURNT, _DRAWS))
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
            here, deviance, slope = there, next_deviance, next_slope
        out.append(here)
    return np.array(out[_BURNT:])


def _spread(mixed: MixedModel, centre: Array) -> Array:
    """(c, c) square root of the covariance that the curvature at the maximum gives the log variances."""
    steps = _STEP * np.eye(len(centre))
    curvature = np.array([deviance_slope(centre + s, mixed)[1] - deviance_slope(centre - s, mixed)[1] for s in steps])
    values, vectors = np.linalg.eigh((curvature + curvature.T) / (8 * _STEP))
    spread = np.asarray(vectors / np.sqrt(np.clip(values, _WIDEST**-2, _SHARPEST**-2)))
    # What no number has stays where it is.
    spread[np.einsum("cbii->c", mixed.components) == 0] = 0.0
    return spread
