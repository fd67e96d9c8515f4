"""An effect as these views fit it: what it changes in the model's prediction, and the dots and line that draw it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stitch.diagnosis.candidates import Form
from stitch.diagnosis.score import Score
from stitch.model.model import Term
from stitch.numerics.frames import Array, Indices
from stitch.numerics.least_squares import fit_columns
from stitch.numerics.reml import at_variances
from stitch.observations.linear_model import LinearModel


@dataclass(frozen=True)
class EffectTrend:
    """D dots, each what the model leaves of a view, with the line of one effect over them."""

    follows: str  # the horizontal axis: view order, time_s, angle of joint 2, …
    unit: str  # of `at`: "", s, °, N m, °C, length_unit
    of: str  # what is off by the vertical axis: the part, the mount, joint 2, …
    value_unit: str  # of the vertical axis: rad, or length_unit
    at: Array  # (D,) horizontal
    views: Indices  # (D,) number of the view of each dot; empty where dots are bins of points
    measured: Array  # (D,) vertical, with no candidate in the model
    sigma: Array  # (D,) standard deviation of a dot, by what is independent between views
    predicted: Array  # (D,) the line: by how much the effect moves what the model predicts
    predicted_sigma: Array  # (D,) standard deviation of the line
    moves: str  # what the effect itself moves: `of`, unless another effect chose the axes
    effect: Array  # (D,) what it does there itself, before hand-eye and effects in use adapt to it
    after: Array | None = None  # (D,) the dots with the effect in the model, where it is in it

    def with_dots(self, dots: Indices) -> "EffectTrend":
        """Return the trend with some of its dots, by their indices."""
        arrays: dict[str, Any] = {name: x[dots] for name, x in vars(self).items() if isinstance(x, np.ndarray)}
        return replace(self, **arrays)


@dataclass(frozen=True)
class Change:
    """What an effect changes in the model's prediction of the reduced observations."""

    per_unit: Array  # (n, p) per unit of each parameter, hand-eye and effects in use fitted anew beside it
    values: Array  # (p,) of the parameters
    covariance: Array  # (p, p)


def fit_change(linear: LinearModel, columns: Array, beside: LinearModel) -> Change:
    """Return the fit of further columns in a linear model: values, covariance, and what they change in its prediction.

    Args:
        columns: (n, p) reduced observations per unit of each parameter.
        beside: the model with the variances that remain beside these columns, for the covariance.
    """
    white = linear.whiten(columns)
    # How hand-eye and effects in use change by a unit of each column: they absorb a part of it.
    absorbed = np.column_stack([fit_columns(linear.white_design, column) for column in white.T]).astype(float)
    residual = beside.residual(columns)
    values = fit_columns(linear.residual(columns), linear.white_residual)
    covariance = np.linalg.pinv(residual.T @ residual).astype(float)
    return Change(columns - linear.reduce(linear.design) @ absorbed, values, covariance)


@dataclass(frozen=True)
class FittedEffect:
    """An effect as these views fit it."""

    term: Term  # with the fitted values
    form: Form
    change: Change


def fit_effect(linear: LinearModel, scored: Score, in_linear: Score) -> FittedEffect:
    """Return an effect with form and values of its score, as they are stated; their covariance is that in `linear`.

    Args:
        in_linear: the score of the same candidate in `linear`.
    """
    beside = linear
    if in_linear.variances is not None:
        beside = replace(linear, null=at_variances(linear.mixed, in_linear.variances))
    change = replace(fit_change(linear, scored.form.columns, beside), values=scored.values)
    return FittedEffect(scored.form.at(scored.values), scored.form, change)
