"""The linear model of labelled points and probes: rows beside hand-eye and landmarks; every view is a block."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.frames import Array, Indices, Mask
from stitch.measurement.measurement import Measurement
from stitch.model.forward import corrected_capture
from stitch.model.model import Model
from stitch.model.term import Term, sizes_of, stack_parameters, values_of
from stitch.observations.arm_errors import joint_offset_twists
from stitch.observations.flange_errors import mean_square_per_axis
from stitch.observations.linear_model import LinearModel
from stitch.observations.response import CoefficientPrior, PointSums, Response
from stitch.observations.targets.effect_rows import effect_columns, effect_rows
from stitch.observations.targets.landmarks import Drawing, Landmarks, initial_landmarks
from stitch.observations.targets.rows import TargetRows, mixed_model_of_rows, target_rows
from stitch.observations.targets.target_trial import TargetTrial
from stitch.statistics.folds import JointEnd, grouped_folds, joint_ends
from stitch.statistics.identifiability import independent
from stitch.statistics.parameter_selection import UNSEEN
from stitch.statistics.variance_components import fit_variances, whitener


@dataclass(frozen=True)
class TargetObservation:
    """A response counts rows: n = B·m of them, those of absent targets at zero."""

    rows: TargetRows
    landmarks: Landmarks

    @property
    def centre(self) -> Array:
        """(3,) of the targets, reference frame."""
        return self.rows.centre

    def from_twists(self, moved: Array) -> Array:
        """(n, P) rows of left twists (6V, P) of the views."""
        return self.rows.from_twists(moved).reshape(self.rows.residual.size, -1)

    def responses(self, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Response]:
        """Rows (n, P) of each term."""
        found = effect_rows(self.rows, measurement, model, terms)
        return [Response(c.reshape(self.rows.residual.size, c.shape[2])) for c in found]

    def reduce(self, response: Array) -> Array:
        """(n, P): the rows themselves."""
        return response

    def expand(self, columns: Array) -> Array:
        """(n, P): the rows themselves."""
        return columns

    def trial(
        self,
        linear: LinearModel,
        response: Array,
        points: PointSums | None = None,
        prior: CoefficientPrior | None = None,
    ) -> TargetTrial:
        """A model with the columns of rows (n, k)."""
        return TargetTrial(self.rows, linear.covariance, linear.in_blocks(response), prior)

    def affected_squares(self, views: Indices) -> Mask:
        """(V,) the views themselves."""
        return np.asarray(np.isin(np.arange(len(self.rows.lever)), views))

    def folds(self) -> list[Indices]:
        """Groups of views to leave out."""
        return self._folds

    @cached_property
    def _folds(self) -> list[Indices]:
        return grouped_folds(self.rows.capture.T_reference_mount, self.rows.reach)

    def joint_ends(self, joints: Array) -> list[JointEnd]:
        """Both ends of every joint's range, of the views that show a target."""
        return joint_ends(joints, np.flatnonzero(self.rows.used.any(axis=1)))

    def part_displacements(self, numbers: Array) -> Array:
        """(V, 3) mean displacement of the targets that a view shows; zero for one that shows none."""
        V = len(self.rows.lever)
        shown = self.rows.used[:, : self.rows.positions : 3]
        moved = numbers.reshape(self.rows.residual.shape)[:V, : self.rows.positions].reshape(V, -1, 3)
        return np.asarray(moved.sum(axis=1) / np.maximum(shown.sum(axis=1), 1)[:, None])


def target_model(measurement: Measurement, model: Model, drawing: Drawing | None) -> LinearModel:
    """Linearise the labelled points of a session about its model.

    Args:
        measurement: with the sightings that count.
    """
    own = corrected_capture(measurement, model)
    landmarks = initial_landmarks(own, model.T_mount, drawing)
    rows = target_rows(own, model.T_mount, landmarks)
    base = np.concatenate([rows.hand_eye, rows.landmarks], axis=2)
    extra = effect_columns(rows, measurement, model)
    parameters = stack_parameters(model.terms)
    sizes = sizes_of(model.terms)
    # Parameters that the fit left at zero are not in the model.
    used = np.array([p.value != 0 and not p.discrete for p in parameters], bool)
    whole = mixed_model_of_rows(rows, np.concatenate([base, extra[..., used]], axis=2))
    null = fit_variances(whole, both_starts=True)
    half = whitener(whole, null.variances)
    n = rows.residual.size
    own_columns, further = ((half @ c).reshape(n, c.shape[2]) for c in (base, extra))
    seen = used & independent(own_columns, further * used, sizes, 1 / UNSEEN)
    A = np.concatenate([base, extra[..., seen]], axis=2)
    mixed = mixed_model_of_rows(rows, A)
    if (seen != used).any():
        null = fit_variances(mixed, both_starts=True)
    values, offsets = values_of(model.terms), joint_offset_twists(measurement, model, rows.centre)
    return LinearModel(
        measurement,
        model,
        TargetObservation(rows, landmarks),
        A.reshape(n, -1),
        sizes=np.append(np.full(base.shape[2], np.inf), sizes[seen]),
        values=np.append(np.zeros(base.shape[2]), values[seen]),
        mixed=mixed,
        null=null,
        offsets=None if offsets is None else rows.from_twists(offsets),
        flange_per_joint=np.zeros(2)
        if offsets is None
        else mean_square_per_axis(offsets, [measurement], [rows.centre]),
    )
