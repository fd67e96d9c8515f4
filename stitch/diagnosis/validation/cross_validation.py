"""What a candidate would leave, in the fit and on views left out, in the linear approximation."""

from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.score import Score, score
from stitch.diagnosis.thresholds import MAX_REMAINING_SHARE
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel, LinearTrial
from stitch.observations.response import CoefficientPrior
from stitch.statistics.shares import mean_square_share

# Of a plausible size: what was not found has some size, or its prior would have none.
_NEGLIGIBLE_SQUARE = 1e-6


@dataclass(frozen=True)
class CrossValidation:
    """Mean square of what remains over that of the present model."""

    inside: float  # fitted on all views
    heldout: float  # each fold judged by a fit without it
    poses: float  # the same for where the views were freed to, in units of their scatter, without the sensor's noise
    poses_sigma: float  # spread of `poses` over folds; each view is in two of them: some 0.6 standard errors
    steadiness: float  # smallest share of the amplitude that remains when one view is left out; < 0: sign changes

    @property
    def helps(self) -> bool:
        """True if views left out are predicted better, by more than folds differ."""
        return self.poses <= 1 - self.poses_sigma

    def rejection_reason(self, name: str) -> str | None:
        """Why an effect should not be in a model of many poses, if it should not: these show even what hardly helps."""
        if self.helps and self.poses <= MAX_REMAINING_SHARE:
            return None
        share = f"{self.poses:.3f} ± {self.poses_sigma:.3f}"
        return f"{name} hardly helps on views left out (mean square error {share} of without)"


def cross_validate(linear: LinearModel, scored: Score) -> CrossValidation:
    """Add the best form of a candidate to the model, in the linear approximation.

    What would be left is told of the fit that `add` makes, in which poses scatter independently; whether views left out
    are predicted, beside everything else that poses may err by.
    """
    fitted = linear.scatter_only
    beside = scored.base_model or linear
    trial, shares, weights, scatter = _residual_shares_by_fold(beside, scored)
    whole = trial
    if beside is not fitted:
        whole, shares, weights, _ = _residual_shares_by_fold(fitted, score(fitted, scored.candidate))
    poses, poses_sigma = mean_square_share(*scatter)
    present = fitted.baseline_trial
    return CrossValidation(
        inside=float(whole.squares(whole.solve()).sum() / present.squares(present.solve()).sum()),
        heldout=float(np.average(shares, weights=weights)),
        poses=poses,
        poses_sigma=poses_sigma,
        steadiness=_steadiness(beside, trial, _model_and_candidate_columns(beside, scored), trial.solve()),
    )


def _model_and_candidate_columns(linear: LinearModel, scored: Score) -> Array:
    """(·, a + k) response to the model and the candidate."""
    return np.hstack([linear.design, scored.form.response])


def _residual_shares_by_fold(linear: LinearModel, scored: Score) -> tuple[LinearTrial, list[float], list[float], Array]:
    """The fit with a candidate; per fold the share of its squares that a fit without it leaves, their weights, and
    (2, G) scatter of its poses."""
    X, points = _model_and_candidate_columns(linear, scored), scored.candidate.points
    own = None if points is None else points.select(scored.form.keep)
    trial, present = linear.trial(X, own), linear.baseline_trial
    believed = linear.trial(X, own, prior_of_sizes(linear, scored))
    shares, weights, scatter = [], [], np.zeros((2, 0))
    for fold in linear.observation.folds():
        touched = linear.observation.affected_squares(fold)
        without = [t.solve(fold) for t in (believed, present)]
        squares = [t.squares(x)[touched].sum() for t, x in zip((trial, present), without, strict=True)]
        shares.append(squares[0] / max(squares[1], 1e-300))
        weights.append(squares[1])
        off = [t.scatter(fold, x) for t, x in zip((trial, present), without, strict=True)]
        scatter = np.column_stack([scatter, off])
    return trial, shares, weights, scatter


def prior_of_sizes(linear: LinearModel, scored: Score) -> CoefficientPrior:
    """Prior for model and candidate in fits without some views.

    Views that carry most of an effect leave little to predict it from where they are left out. So without them the
    effect is believed to be as large as it was found with all views, of either sign, and no larger: what little is
    left to see does not count for more than that.
    """
    size = np.hypot(scored.values, np.nan_to_num(scored.sigmas))
    size = np.maximum(size, _NEGLIGIBLE_SQUARE * scored.form.sizes)
    precision = np.append(np.zeros(linear.design.shape[1]), 1 / size**2)
    return CoefficientPrior(precision, np.zeros(len(precision)))


def _steadiness(linear: LinearModel, trial: LinearTrial, X: Array, whole: Array) -> float:
    """A combination of parameters that one view carries alone vanishes without it."""
    size = X.shape[1] - linear.design.shape[1]
    theta = whole[-size:]
    if not theta.any():
        return 0.0
    white = linear.residual(linear.reduce(X[:, -size:]))
    strength = float(np.sum((white @ theta) ** 2))
    shares = [
        float((white @ theta) @ (white @ trial.solve(np.array([v]))[-size:])) / max(strength, 1e-300)
        for v in trial.influential_views(whole)
    ]
    return min(shares)
