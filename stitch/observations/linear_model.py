"""The one linear form that all of diagnosis reads, whatever was observed.

    z = A·α + noise,   cov(noise) = Σ_i λ_i C_i

z are the numbers that were seen (channel), A what hand-eye, landmarks and effects in use do to them. An observation
says how its own coordinates (responses: twists of the views, or rows of targets) become numbers of the channel, how
a model with further columns is tried, and which views may be left out. A further kind of observation implements
`Observation` and a function that returns a `LinearModel`; nothing of diagnosis changes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from stitch.frames import Array, Indices, Mask
from stitch.measurement.measurement import Measurement
from stitch.model.model import Model
from stitch.model.term import Term
from stitch.observations.error_model import ErrorModel
from stitch.observations.response import CoefficientPrior, PointSums, Response
from stitch.statistics.folds import JointEnd
from stitch.statistics.least_squares import column_space
from stitch.statistics.variance_components import fit_variances


class LinearTrial(Protocol):
    """A model with some columns, in the linear approximation."""

    def solve(self, left_out: Indices | None = None) -> Array:
        """(k,) coefficients by least squares, without some views."""
        ...

    def squares(self, coefficients: Array) -> Array:
        """(units,) sums of squares of what remains, in the terms of residual_rms."""
        ...

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """Sum of squares by which left-out views lie off, in units of their scatter."""
        ...

    def influential_views(self, coefficients: Array) -> Indices:
        """(n,) views of which one alone could carry the coefficients (k,)."""
        ...


class Observation(Protocol):
    """What was observed of one session under its model, in its own coordinates."""

    @property
    def centre(self) -> Array:
        """(3,) about which twists of the views count, reference frame."""
        ...

    def from_twists(self, moved: Array) -> Array:
        """(n, P) numbers of the channel of left twists (6V, P) of the views."""
        ...

    def responses(self, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Response]:
        """Per term how the observation answers to its parameters."""
        ...

    def reduce(self, response: Array) -> Array:
        """(n, P) numbers of the channel of a response (·, P)."""
        ...

    def expand(self, columns: Array) -> Array:
        """(·, P) a response that has these numbers (n, P) of the channel."""
        ...

    def trial(
        self,
        linear: "LinearModel",
        response: Array,
        points: PointSums | None = None,
        prior: CoefficientPrior | None = None,
    ) -> LinearTrial:
        """A model with the columns of a response (·, k); `points` belong to its last ones; prior of k coefficients."""
        ...

    def affected_squares(self, views: Indices) -> Mask:
        """(units,) which squares of a trial some views have a part in."""
        ...

    def folds(self) -> list[Indices]:
        """Groups of views to leave out."""
        ...

    def joint_ends(self, joints: Array) -> list[JointEnd]:
        """Ends of joints' ranges that may be left out; none where a square of a trial is no view's own."""
        ...

    def part_displacements(self, numbers: Array) -> Array:
        """(V, 3) what numbers (n,) of the channel displace at the part, reference frame, without a common motion."""
        ...


@dataclass(frozen=True)
class LinearModel(ErrorModel):
    """One session under its model: what was seen beside hand-eye, landmarks and effects in use, in the channel."""

    measurement: Measurement
    model: Model
    observation: Observation
    design: Array  # (·, a) response to hand-eye, landmarks and effects in use
    sizes: Array  # (a,) plausible ones of the effects' parameters; infinite for the rest
    values: Array  # (a,) at which the parameters of effects in use stand; 0 for the rest

    def responses(self, terms: Sequence[Term]) -> list[Response]:
        """Per term how the observation answers to its parameters."""
        return self.observation.responses(self.measurement, self.model, terms)

    def reduce(self, response: Array) -> Array:
        """(n, P) numbers of the channel of a response (·, P)."""
        return self.observation.reduce(response)

    @cached_property
    def white_design(self) -> Array:
        """(n, a) `design` in units of the null's scatter."""
        return self.whiten(self.reduce(self.design))

    @cached_property
    def white_z(self) -> Array:
        """(n,) what was seen in those units, with all that the model explains."""
        return self.whiten(self.mixed.z.reshape(-1, 1))[:, 0]

    @cached_property
    def white_residual(self) -> Array:
        """(n,) what was seen in those units, without what the model explains."""
        return self.residual(self.mixed.z.reshape(-1, 1))[:, 0]

    @cached_property
    def _explained(self) -> Array:
        """(n, r) orthonormal basis of `white_design`."""
        return column_space(self.white_design)

    def residual(self, columns: Array) -> Array:
        """(n, P) whitened columns of the channel, what the model explains projected out."""
        white = self.whiten(columns)
        return np.asarray(white - self._explained @ (self._explained.T @ white))

    def conditioned_on(self, columns: Array, sizes: Array, near: "LinearModel | None" = None) -> "LinearModel":
        """The linear model with further free columns (n, p) of the channel, of parameters of plausible sizes (p,).

        Args:
            near: one that leaves about as much scatter, from which the search for it begins.
        """
        mixed = replace(self.mixed, A=np.concatenate([self.mixed.A, self.in_blocks(columns)], axis=2))
        design = np.hstack([self.design, self.observation.expand(columns)])
        own = np.append(self.sizes, sizes), np.append(self.values, np.zeros(len(sizes)))
        out = replace(self, design=design, sizes=own[0], values=own[1], mixed=mixed, full_model=None)
        if self.pose_errors is None:
            return replace(out, null=fit_variances(mixed, start=(near or self).null.variances))
        return out.refit()

    def trial(
        self, response: Array, points: PointSums | None = None, prior: CoefficientPrior | None = None
    ) -> LinearTrial:
        """A model with the columns of a response (·, k)."""
        return self.observation.trial(self, response, points, prior)

    @cached_property
    def baseline_trial(self) -> LinearTrial:
        """The model as it is."""
        return self.trial(self.design)

    def view_displacements(self) -> Array:
        """(V, 3) how far every view sits from where the model puts it, at the part, reference frame."""
        explained = self.reduce((self.design @ self.baseline_trial.solve())[:, None])[:, 0]
        return self.observation.part_displacements(self.mixed.z.ravel() - explained)

    def __repr__(self) -> str:
        return f"LinearModel({self.mixed.size} numbers of {self.measurement.views.count} views, {self.model!r})"
