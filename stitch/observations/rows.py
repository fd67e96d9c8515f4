"""Observations in rows: every view shows numbers of its own, each of a point or a turn that it sees.

A kind of observation is a subclass of `Rows`: what is left of each number, how it answers to a motion of its view and
to what is unknown beside the hand-eye, its noise, and how it answers to points that move. `row_model`
(`row_model.py`) makes of it the linear model that all of diagnosis reads.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.model.forward import PointSlopes, moves_points, pose_derivatives
from stitch.model.model import Model, Term
from stitch.numerics import frames
from stitch.numerics.common_covariance import CommonCovariance, common_covariance
from stitch.numerics.frames import Array, Mask
from stitch.numerics.reml import MixedModel
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement


@dataclass(frozen=True, kw_only=True)
class Rows(ABC):
    """Observations as B blocks of m rows, linearised about a model: the first V blocks are those of the V views.

    Beside the hand-eye they have U unknowns, such as places of targets.
    """

    capture: Capture  # without the effects in use
    T_mount: Array  # (4, 4) maps sensor to mount
    centre: Array  # (3,) point of the reference frame about which twists of the views turn
    residual: Array  # (B, m) observed numbers less those that the model predicts
    lever: Array  # (V, m, 6) change of the rows per left twist of the view about the centre
    landmarks: Array  # (B, m, U) change of the rows per unknown of what is seen: places of targets, a plane
    noise: Array  # (B, m) variance of the sensor; 0 where a row is absent or none of the sensor's

    @abstractmethod
    def point_rows(self, moved: Array) -> Array:
        """Return the change (P, V, m) of the rows where labelled points move by (P, V, S, 3), reference frame."""

    @property
    def fixed(self) -> Array:
        """(B, m) variance of each row that is known, not fitted: 1 in absent rows, as covariances need an inverse."""
        return (self.noise == 0).astype(float)

    @cached_property
    def used(self) -> Mask:
        """(V, m) mask of the rows of views that were measured."""
        return self.noise[: len(self.lever)] > 0

    @cached_property
    def distances_used(self) -> Mask:
        """(V, m) mask of the measured rows that are lengths: rms residuals are of these."""
        return self.used

    @cached_property
    def hand_eye(self) -> Array:
        """(B, m, 6) change of the rows per right twist ξ of the hand-eye, T_mount·exp(ξ); zero in blocks of no view."""
        of_views = self.lever @ frames.adjoint_about(self.centre, self.capture.hand_eye_frames(self.T_mount))
        return np.concatenate([of_views, np.zeros((len(self.residual) - len(of_views), *of_views.shape[1:]))])

    @property
    def reach(self) -> float:
        """Median distance, length_unit, from the flange to what is seen: by so much a radian of the flange moves it."""
        away = np.linalg.norm(self.centre - self.capture.T_reference_flange[:, :3, 3], axis=1)
        return float(max(np.median(away), 1e-9))

    def effect_columns(self, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Array]:
        """Return per term the change (B, m, P) of the rows per unit of each of its parameters, at `model`.

        An effect that moves a view as a whole acts through `lever`; one that moves points, through the targets.
        """
        derivatives = pose_derivatives(measurement, model, [t for t in terms if not moves_points([t])], self.centre)
        poses = self.capture.poses(self.T_mount)
        columns = []
        for term in terms:
            of_term = np.zeros((*self.residual.shape, len(term.parameters)))
            if moves_points([term]):
                slopes = PointSlopes(measurement, [term], model).at_targets(poses)
                of_term[: len(poses)] = np.moveaxis(self.point_rows(frames.rotate(poses, slopes)), 0, -1)
                of_term[: len(poses)][~self.used] = 0.0
            else:
                of_term[: len(poses)] = self.lever @ next(derivatives).transpose(1, 2, 0)
            columns.append(of_term)
        return columns

    def columns_in_use(self, measurement: Measurement, model: Model) -> Array:
        """Return the change (B, m, P) of the rows per unit of each parameter of the effects in use."""
        columns = self.effect_columns(measurement, model, model.terms)
        return np.concatenate([np.zeros((*self.residual.shape, 0)), *columns], axis=2)

    def mixed_model(self, A: Array) -> MixedModel:
        """Return the mixed model of the rows: a block of m rows a view, then the blocks of no view.

        Its three components are rotation scatter and translation scatter of the flange, and the sensor's noise.

        Args:
            A: (B, m, a) columns of the free mean.
        """
        V, (B, m) = len(self.lever), self.residual.shape
        components = np.zeros((3, B, m, m))
        for i, scattered in enumerate(self.scattered):
            components[i, :V] = scattered @ scattered.transpose(0, 2, 1)
        diagonal = np.arange(m)
        components[2][:, diagonal, diagonal] = self.noise
        fixed = np.zeros((B, m, m))
        fixed[:, diagonal, diagonal] = self.fixed
        return MixedModel(-self.residual, A, components, fixed, self.independent, common=self._common_covariance)

    @property
    def independent(self) -> int:
        """Return how many numbers err independently; less the unknowns of a fit, they are its degrees of freedom.

        A view counts six, as many as its pose has, or its rows where they are fewer. The U unknowns of the landmarks
        are added, since a fit subtracts them later; all but six, the motions of all landmarks as one body, which the
        poses have already.
        """
        rows_of_poses = np.minimum(self.used.sum(axis=1), 6).sum()
        return int(rows_of_poses) + max(self.landmarks.shape[2] - 6, 0)

    @cached_property
    def scattered(self) -> tuple[Array, Array]:
        """(V, m, 3) changes of the rows per rotation, and per translation, of the flange in its own frame."""
        per_flange_twist = self.lever @ frames.adjoint_about(self.centre, self.capture.T_reference_flange)
        return per_flange_twist[..., :3], per_flange_twist[..., 3:]

    @cached_property
    def _common_covariance(self) -> CommonCovariance | None:
        """The blocks in groups of one covariance but for a rotation; None where they form none."""
        return common_covariance(self.scattered, self.noise, self.fixed)
