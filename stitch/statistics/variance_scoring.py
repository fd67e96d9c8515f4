"""Fisher scoring of variance components, where their maximum lies near."""

import numpy as np

from stitch.frames import Array
from stitch.statistics.restricted_likelihood import Likelihood, RemlProblem, likelihood
from stitch.statistics.variance_prior import log_prior, prior_information

# Scoring steps, their largest leap in a log variance, how often one is halved, the deviance that is not worth another
# (rounding alone moves that of thousands of numbers by a tenth of it), and the blocks from which they pay.
_SCORINGS, _LEAP, _HALVINGS, _CONVERGED, _MANY_BLOCKS = 20, 2.0, 4, 1e-3, 50
# Deviance gained by a step that is the last one: another would gain a fiftieth of it at the most, as
# seen in the fits of 600 labelled poses; where a prior bends the slope it would gain more.
_LAST = 0.2
# Change of a variance, as a share of it, beyond which little of it would be left.
_NEARLY_NONE = -0.8


def fisher_scoring(problem: RemlProblem, start: Array, flat: float) -> tuple[Array, Likelihood] | None:
    """(c,) log variances at the maximum by Fisher scoring, where it lies near; None where a search must look for it.

    The expected curvature of the deviance is λ_iλ_j tr(V⁻¹C_iV⁻¹C_j), less what the mean takes. With thousands of
    numbers in small blocks three steps do what a search without curvature needs sixteen for.
    """
    mixed = problem.mixed
    if len(mixed.z) < _MANY_BLOCKS:
        return None
    x, here = start, likelihood(start, problem)
    for _ in range(_SCORINGS):
        if np.abs(here.slope).max() < flat:
            return x, here
        variances = np.exp(x)
        shares = variances[:, None, None, None] * (here.inverse.matrix @ mixed.components)
        curvature = shares.reshape(len(x), -1) @ shares.transpose(0, 1, 3, 2).reshape(len(x), -1).T
        curvature += np.diag(2 * prior_information(variances, mixed.further))
        step = _scoring_step(curvature, here.slope, np.maximum(here.slope - log_prior(x, mixed.further)[1], 0))
        gain = -0.5 * float(here.slope @ step)
        if gain < _CONVERGED:
            return x, here
        for _ in range(_HALVINGS):
            there = likelihood(x + step, problem)
            if there.deviance <= here.deviance + _CONVERGED:
                break
            step /= 2
        else:
            return None
        x, here = x + step, there
        if gain < _LAST and mixed.further is None:
            return x, here
    return None


def _scoring_step(curvature: Array, slope: Array, weak: Array) -> Array:
    """(c,) in the log variances.

    In the variances themselves scoring is exact where one of them decides. One that it would make negative is hardly
    seen: there the likelihood curves, in the logarithm, by its slope.
    """
    share = -np.linalg.solve(curvature, slope)
    if share.min() > _NEARLY_NONE:
        return np.asarray(np.log1p(share))
    step = -np.linalg.solve(curvature + np.diag(weak), slope)
    return np.asarray(step * min(1.0, _LEAP / float(np.abs(step).max())))
