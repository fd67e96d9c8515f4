"""Whether effects that cannot be told apart predict views left out, all of them together."""

from collections.abc import Sequence

import numpy as np

from stitch.diagnosis.score import Score
from stitch.diagnosis.validation.cross_validation import prior_of_sizes
from stitch.observations.linear_model import LinearModel
from stitch.observations.response import CoefficientPrior
from stitch.statistics.shares import mean_square_share


def group_helps(share: float, sigma: float) -> bool:
    """True if a group leaves less on views left out, by more than folds differ."""
    return share <= 1 - sigma


def group_share(linear: LinearModel, group: Sequence[Score]) -> tuple[float, float]:
    """How far left-out poses lie from what the group predicts over how far from the present model, mean square.

    Returns:
        The share, and its standard error with folds as samples. Effects of points count by what they do to poses.
    """
    a = linear.design.shape[1]
    precision = np.concatenate([np.zeros(a), *(prior_of_sizes(linear, own).precision[a:] for own in group)])
    prior = CoefficientPrior(precision, np.zeros(len(precision)))
    trial = linear.trial(np.hstack([linear.design, *(own.form.response for own in group)]), None, prior)
    pairs = [(t, t.solve(fold), fold) for fold in linear.observation.folds() for t in (trial, linear.baseline_trial)]
    off = np.array([t.scatter(fold, found) for t, found, fold in pairs]).reshape(-1, 2)
    return mean_square_share(off[:, 0], off[:, 1])
