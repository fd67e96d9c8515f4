"""How large errors of planned views would be found: what they would see is drawn, and fitted as a run fits it.

No number of views excludes that an arm errs by a little more than its scatter; how much they leave open is what the
covariance of a run counts. It is the posterior mean of the variances, averaged over draws.
"""

from dataclasses import replace

import numpy as np

from stitch.planning.expected_model import ExpectedModel
from stitch.planning.scatter import FittedScatter, Scatter, mean_scatter
from stitch.statistics.variance_components import fit_variances
from stitch.statistics.variance_posterior import mean_variances

# Draws among so many numbers at the most; a fit among more takes seconds, and the expected variances must do.
_DRAWS = ((150, 3), (400, 1))


def expected_scatter(linear: ExpectedModel, noise: float) -> FittedScatter:
    """What runs of these views would find, on average, where the scatter is the expected one.

    Args:
        noise: of the scans.
    """
    draws = next((count for size, count in _DRAWS if linear.mixed.size <= size), 0)
    if not draws or linear.pose_errors is None:
        return mean_scatter(linear, noise, [(linear.null.variances, linear.null.variances)])
    half, rng, found = np.linalg.cholesky(linear.covariance[0]), np.random.default_rng(0), []
    for _ in range(draws):
        mixed = replace(linear.mixed, z=(half @ rng.standard_normal(len(half)))[None])
        null = fit_variances(mixed, both_starts=True)
        found.append((null.variances, mean_variances(mixed, null)))
    return mean_scatter(linear, noise, found)


def with_scatter(linear: ExpectedModel, scatter: Scatter) -> ExpectedModel:
    """The same views under another scatter."""
    names = () if linear.pose_errors is None else linear.pose_errors.names
    return linear.at(scatter.variances(names))
