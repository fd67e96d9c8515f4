"""Covariance counted in views: leaving one out at a time, from normal equations alone.

A covariance from single points or coordinates takes every one as independent. The robot's pose errs
once per view, so views are the samples. Leaving a view out is one Newton step from the solution.
"""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.statistics.jackknife import grouped_inflation


@dataclass(frozen=True)
class Jackknife:
    """What leaving one view out at a time says, for n parameters and V views."""

    covariance: Array  # (n, n) the model's, times the inflation
    inflation: float  # mean ratio of the jackknife's covariance to the model's, at least 1
    steps: Array  # (V, n) change of the parameters without each view


def jackknife(information: Array, gradient: Array, model: Array | None = None) -> Jackknife:
    """Covariance of a weighted least-squares solution.

    Args:
        information: (V, n, n) JᵀWJ of each view.
        gradient: (V, n) JᵀWe of each view at the solution, e the residual.
        model: (n, n) covariance that the scatter of the residuals predicts; without it the inverse of
            the information, right where the weights W are inverse covariances.

    The jackknife of Efron & Stein (1981) never goes below the truth on average, so it only inflates.
    """
    count, n = gradient.shape
    total = information.sum(axis=0)
    model = np.linalg.inv(total) if model is None else model
    steps = np.zeros((count, n))
    for v in range(count):
        # Without a view whose loss makes the rest singular no step can be taken: it has no partner.
        steps[v] = np.linalg.lstsq(total - information[v], gradient[v], rcond=1e-12)[0]
    # Steps of few views hardly span the parameters: they say nothing about the spread.
    inflation = grouped_inflation(steps, model) if count > n / 2 + 2 else 1.0
    return Jackknife(model * inflation, inflation, steps)
