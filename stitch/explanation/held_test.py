"""Whether a sum of ingredients that one half of the views suggests is what the other half, which took no part, shows.

Beside everything else that poses may err by, under the scatter that is left once the sum is taken out: a χ² test, and
how much likelier the numbers of that half are with the sizes that the first half found (a partial Bayes factor; Berger
& Pericchi 1996, J. Am. Stat. Assoc. 91:109).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.thresholds import ODDS
from stitch.explanation.dictionary import Dictionary, Ingredient
from stitch.explanation.half import HalfModel
from stitch.frames import Array, Indices
from stitch.observations.flange_errors import DRIFT_MEMORY
from stitch.observations.linear_model import LinearModel
from stitch.statistics.tails import chi2_tail
from stitch.statistics.variance_components import at_variances
from stitch.statistics.variance_prior import NOISE

_REJECTED = 0.01
# A prior of this many sizes as they come out keeps what a half does not see finite.
_PRIOR_WIDTH = 10.0
_MIN_PRIOR_SIGMA = 1e-6


@dataclass(frozen=True)
class TestedSum:
    """A sum of ingredients, and how it stood the test."""

    ingredients: tuple[Ingredient, ...]
    p_value: float  # in the half that took no part in choosing, all ways counted
    log_bayes_factor: float  # of that half's numbers with the sizes of the other over none
    both: float  # the same, with that of the other half's numbers with the sizes of this one
    instead_of: tuple[Ingredient, ...] = ()  # the sum that stood the test, where all views want another in its place

    @property
    def holds(self) -> bool:
        """True if the half that took no part wants it."""
        return self.p_value < _REJECTED and self.log_bayes_factor > ODDS


def test_current_scatter(ingredients: tuple[Ingredient, ...], chosen: HalfModel, other: HalfModel) -> TestedSum:
    """The test under the present scatter."""
    return _test_sum(ingredients, *((half.columns(ingredients), half.z) for half in (chosen, other)))


def test_refitted_scatter(
    linear: LinearModel, terms: Dictionary, ingredients: tuple[Ingredient, ...], slow: bool, splits: Sequence[Indices]
) -> TestedSum:
    """The test under the scatter that is left beside the sum.

    Args:
        slow: the sum follows time or what moves with it.
        splits: views in which the sum was chosen, and those in which it is tested; both leave numbers free beside it.
    """
    own = terms.columns(ingredients)
    other = HalfModel(linear.scatter_only, terms, splits[0])
    sizes = (
        _PRIOR_WIDTH * np.abs(np.linalg.lstsq(other.residual_columns(own), other.z, rcond=None)[0]) + _MIN_PRIOR_SIGMA
    )
    base = _with_test_scatter(linear, linear.reduce(own), sizes, slow)
    halves = [HalfModel(base, terms, views) for views in splits]
    return _test_sum(ingredients, *((half.residual_columns(own), half.z) for half in halves))


def fitted_sizes(linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient]) -> Array:
    """(k,) sizes of scaled columns from all views, under the scatter that they leave."""
    base, own = with_refitted_scatter(linear, terms, ingredients), linear.reduce(terms.columns(ingredients))
    return np.asarray(np.linalg.lstsq(base.residual(own), base.white_residual, rcond=None)[0])


def with_refitted_scatter(linear: LinearModel, terms: Dictionary, ingredients: Sequence[Ingredient]) -> LinearModel:
    """The model under the scatter that a sum leaves."""
    beside = linear.conditioned_on(linear.reduce(terms.columns(ingredients)), np.full(len(ingredients), 1.0))
    return replace(linear, null=at_variances(linear.mixed, beside.null.variances))


def _test_sum(
    ingredients: tuple[Ingredient, ...], chosen: tuple[Array, Array], tested: tuple[Array, Array]
) -> TestedSum:
    """A sum by its columns and the numbers of either half, in units of the scatter."""
    (A, y), (B, w) = chosen, tested
    told = np.linalg.pinv(B.T @ B, rcond=1e-12, hermitian=True)
    square = float((B.T @ w) @ told @ (B.T @ w))
    factor = _log_predictive_ratio(A, y, B, w)
    return TestedSum(
        ingredients, chi2_tail(square, len(ingredients)), factor, factor + _log_predictive_ratio(B, w, A, y)
    )


def _with_test_scatter(linear: LinearModel, own: Array, sizes: Array, slow: bool) -> LinearModel:
    """Under the scatter that is left beside a sum: what it explains is no scatter. What wanders in time stays."""
    if slow and linear.pose_errors is None:
        return linear
    variances = linear.conditioned_on(own, sizes).null.variances.copy()
    if slow and linear.pose_errors is not None:
        wanders = NOISE + 1 + np.flatnonzero(np.isin(linear.pose_errors.names, list(DRIFT_MEMORY)))
        variances[wanders] = np.maximum(variances, linear.null.variances)[wanders]
    return replace(linear, null=at_variances(linear.mixed, variances))


def _log_predictive_ratio(A: Array, y: Array, B: Array, w: Array) -> float:
    """Log likelihood ratio of w = B·x for what y = A·x tells of x, over none."""
    mean = np.asarray(np.linalg.lstsq(A, y, rcond=None)[0], float)
    precision = A.T @ A + np.diag((_PRIOR_WIDTH * np.abs(mean) + _MIN_PRIOR_SIGMA) ** -2.0)
    information, vector = B.T @ B, B.T @ w
    both = precision + information
    pull = vector + precision @ mean
    square = pull @ np.linalg.solve(both, pull) - mean @ precision @ mean
    return float(0.5 * square - 0.5 * (np.linalg.slogdet(both)[1] - np.linalg.slogdet(precision)[1]))
