"""Observations in rows: every view shows numbers of its own, each of a point or a turn that it sees.

A kind of observation is a subclass of `Rows`: what is left of each number, how it answers to a motion of its view and
to what is unknown beside the hand-eye, its noise, and how it answers to points that move. `row_model` makes of it the
linear model that all of diagnosis reads.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.model.forward import PointSlopes, moves_points, pose_derivatives
from stitch.model.model import Model, Term, sizes_of, stack_parameters, values_of
from stitch.numerics import frames
from stitch.numerics.common_covariance import CommonCovariance, common_covariance
from stitch.numerics.folds import JointEnd, joint_ends
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import BlockLeastSquares, equilibrated, independent
from stitch.numerics.parameter_selection import UNSEEN
from stitch.numerics.reml import MixedModel, fit_variances, whitener
from stitch.observations.linear_model import CoefficientPrior, LinearModel, Observation, PointSums, Response
from stitch.observations.pose_errors import joint_offset_twists, mean_square_per_axis
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement

# Views of largest influence on the estimates: if one alone carries them, it is among these.
_CARRIERS = 20


@dataclass(frozen=True, kw_only=True)
class Rows(Observation):
    """V views, B ≥ V blocks of m rows, those beyond V of no view; U unknowns beside the hand-eye."""

    capture: Capture  # without the effects in use
    T_mount: Array  # (4, 4)
    centre: Array  # (3,) about which twists of the views count, reference frame
    residual: Array  # (B, m) what a view shows less what it should
    lever: Array  # (V, m, 6) rows per left twist of the view about the centre
    landmarks: Array  # (B, m, U) rows per unknown of what is seen: places of targets, a plane
    noise: Array  # (B, m) variance of the sensor; 0 where a row is absent or none of the sensor's

    @abstractmethod
    def point_rows(self, moved: Array) -> Array:
        """(P, V, m) change of the rows where labelled points move by (P, V, S, 3), reference frame."""

    @property
    def fixed(self) -> Array:
        """(B, m) variance that is known: 1 in absent rows."""
        return (self.noise == 0).astype(float)

    @cached_property
    def used(self) -> Mask:
        """(V, m) bool: rows of the views that were measured."""
        return self.noise[: len(self.lever)] > 0

    @cached_property
    def distances_used(self) -> Mask:
        """(V, m) bool: those of them that are lengths, as what remains is told."""
        return self.used

    @cached_property
    def hand_eye(self) -> Array:
        """(B, m, 6) rows per right perturbation of the hand-eye."""
        to_centre = frames.make(np.eye(3), -self.centre)
        of_views = self.lever @ frames.adjoint(to_centre @ self.capture.hand_eye_frames(self.T_mount))
        return np.concatenate([of_views, np.zeros((len(self.residual) - len(of_views), *of_views.shape[1:]))])

    @property
    def reach(self) -> float:
        """Distance of what is seen from the flange: what a turn of it moves the points by."""
        away = np.linalg.norm(self.centre - self.capture.T_reference_flange[:, :3, 3], axis=1)
        return float(max(np.median(away), 1e-9))

    @property
    def numbers_per_view(self) -> int:
        """Those of a view's block."""
        return int(self.residual.shape[1])

    def from_twists(self, moved: Array) -> Array:
        """Return rows (B·m, P) of left twists (6V, P) of the views about the centre."""
        out = np.zeros((*self.residual.shape, moved.shape[1]))
        out[: len(self.lever)] = self.lever @ moved.reshape(-1, 6, moved.shape[1])
        return out.reshape(self.residual.size, moved.shape[1])

    def responses(self, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Response]:
        """Return rows (B·m, P) of each term."""
        columns = self.effect_columns(measurement, model, terms)
        return [Response(c.reshape(self.residual.size, c.shape[2])) for c in columns]

    def trial(self, linear: LinearModel, response: Array, points: PointSums | None = None) -> "RowTrial":
        """Return a model with the columns of rows (B·m, k)."""
        return RowTrial(self, linear, linear.in_blocks(response))

    def affected_squares(self, views: Indices) -> Mask:
        """Return the views themselves, (V,) bool."""
        mask: Mask = np.asarray(np.isin(np.arange(len(self.lever)), views))
        return mask

    def joint_ends(self, joints: Array) -> list[JointEnd]:
        """Return both ends of every joint's range, of the views that show anything."""
        return joint_ends(joints, np.flatnonzero(self.used.any(axis=1)))

    def part_displacements(self, numbers: Array) -> Array:
        """Return the motion (V, 3) of a view that makes its rows by shifts alone; zero for one that shows nothing."""
        left = numbers.reshape(self.residual.shape)[: len(self.lever), :, None]
        return (self._of_shifts @ left)[..., 0]

    @cached_property
    def _of_shifts(self) -> Array:
        """(V, 3, m) shifts of the views that make their rows."""
        return np.linalg.pinv(self.lever[..., 3:] * self.distances_used[..., None]).astype(float)

    def effect_columns(self, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Array]:
        """Per term (B, m, P) how the rows answer to its parameters, at `model`."""
        of_views = pose_derivatives(measurement, model, [t for t in terms if not moves_points([t])], self.centre)
        poses = self.capture.poses(self.T_mount)
        out = []
        for term in terms:
            if not moves_points([term]):
                moved = next(of_views)
                rows = self.from_twists(moved.reshape(len(moved), -1).T)
                out.append(rows.reshape(*self.residual.shape, rows.shape[1]))
                continue
            slopes = PointSlopes(measurement, [term], model).at_targets(poses)
            rows = np.zeros((*self.residual.shape, len(slopes)))
            rows[: len(poses)] = np.moveaxis(self.point_rows(frames.rotate(poses, slopes)), 0, -1)
            rows[: len(poses)][~self.used] = 0.0
            out.append(rows)
        return out

    def columns_in_use(self, measurement: Measurement, model: Model) -> Array:
        """(B, m, P) how the rows answer to all parameters of the effects in use."""
        columns = self.effect_columns(measurement, model, model.terms)
        return np.concatenate([np.zeros((*self.residual.shape, 0)), *columns], axis=2)

    def mixed_model(self, A: Array) -> MixedModel:
        """Rows as blocks for the variance components; `A` (B, m, a) are the columns of the free mean."""
        V, (B, m) = len(self.lever), self.residual.shape
        components = np.zeros((3, B, m, m))
        for i, scattered in enumerate(self._scattered):
            components[i, :V] = scattered @ scattered.transpose(0, 2, 1)
        diagonal = np.arange(m)
        components[2][:, diagonal, diagonal] = self.noise
        fixed = np.zeros((B, m, m))
        fixed[:, diagonal, diagonal] = self.fixed
        # A view errs in six ways, whatever it shows; what it shows beyond that, the landmarks take up.
        independent = int(np.minimum(self.used.sum(axis=1), 6).sum()) + max(self.landmarks.shape[2] - 6, 0)
        return MixedModel(-self.residual, A, components, fixed, independent, common=self._common_covariance)

    @cached_property
    def _scattered(self) -> tuple[Array, Array]:
        """(V, m, 3) rows per rotation, and per translation, of the flange in its own frame."""
        to_centre = frames.make(np.eye(3), -self.centre)
        carried = self.lever @ frames.adjoint(to_centre @ self.capture.T_reference_flange)
        return carried[..., :3], carried[..., 3:]

    @cached_property
    def _common_covariance(self) -> CommonCovariance | None:
        return common_covariance(self._scattered, self.noise, self.fixed)


def row_model(measurement: Measurement, model: Model, rows: Rows) -> LinearModel:
    """Return the linear model of what a session shows in rows: hand-eye, landmarks and effects in use are free.

    Args:
        measurement: with the sightings that count.
    """
    base = np.concatenate([rows.hand_eye, rows.landmarks], axis=2)
    extra = rows.columns_in_use(measurement, model)
    sizes, values = sizes_of(model.terms), values_of(model.terms)
    # Parameters that the fit left at zero are not in the model.
    used = np.array([p.value != 0 and not p.discrete for p in stack_parameters(model.terms)], bool)
    whole = rows.mixed_model(np.concatenate([base, extra[..., used]], axis=2))
    null = fit_variances(whole, both_starts=True)
    half = whitener(whole, null.variances)
    n = rows.residual.size
    white_base = (half @ base).reshape(n, base.shape[2])
    white_extra = (half @ extra).reshape(n, extra.shape[2])
    seen = used & independent(white_base, white_extra * used, sizes, 1 / UNSEEN)
    A = np.concatenate([base, extra[..., seen]], axis=2)
    mixed = rows.mixed_model(A)
    if (seen != used).any():
        null = fit_variances(mixed, both_starts=True)
    offsets = joint_offset_twists(measurement, model, rows.centre)
    per_joint = np.zeros(2) if offsets is None else mean_square_per_axis(offsets, [measurement], [rows.centre])
    return LinearModel(
        measurement,
        model,
        rows,
        A.reshape(n, -1),
        sizes=np.append(np.full(base.shape[2], np.inf), sizes[seen]),
        values=np.append(np.zeros(base.shape[2]), values[seen]),
        mixed=mixed,
        null=null,
        offsets=None if offsets is None else rows.from_twists(offsets).reshape(*rows.residual.shape, -1),
        flange_per_joint=per_joint,
    )


@dataclass(frozen=True)
class RowTrial:
    """Columns of rows with the covariance of the null, fitted as a run fits them."""

    rows: Rows
    linear: LinearModel
    X: Array  # (B, m, k)

    @cached_property
    def blocks(self) -> BlockLeastSquares:
        nothing = np.zeros(self.X.shape[2])
        return BlockLeastSquares(-self.rows.residual, self.X, self.linear.covariance, nothing, nothing)

    def solve(self, left_out: Indices | None = None) -> Array:
        """Coefficients (k,) without some views."""
        return self.blocks.solve(left_out)

    def solve_each(self, priors: Sequence[CoefficientPrior], left_out: Indices | None = None) -> list[Array]:
        """Coefficients (k,) under each prior, without some views; zero beyond those that it is of."""
        solutions = self.blocks.solve_each([(p.precision, p.precision * p.mean) for p in priors], left_out)
        return [np.pad(x, (0, self.X.shape[2] - len(x))) for x in solutions]

    def squares(self, coefficients: Array, units: Indices | Mask | None = None) -> Array:
        """(V,) sums of the squares of a view's distances, of all views or of some."""
        units = np.arange(len(self.rows.lever)) if units is None else units
        return np.sum(self._rest(coefficients, units) ** 2 * self.rows.distances_used[units], axis=1)

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """Sum of the squares of what left-out views show, in units of their scatter and the sensor's noise."""
        rest = self._rest(coefficients, left_out) * self.rows.used[left_out]
        return float(np.sum((self.linear.whitening[left_out] @ rest[..., None]) ** 2))

    def influential_views(self, coefficients: Array) -> Indices:
        """(n,) the views without which the coefficients would move most, to first order."""
        scaled, unit = equilibrated(self.blocks.information)
        moves = self.blocks.residual_vectors(coefficients) * unit @ np.linalg.pinv(scaled, rcond=1e-14, hermitian=True)
        sizes = np.linalg.norm(moves[: len(self.rows.lever)], axis=1)
        return np.argsort(-sizes, kind="stable")[:_CARRIERS].astype(np.int64)

    def _rest(self, coefficients: Array, views: Indices | Mask) -> Array:
        V = len(self.rows.lever)
        return self.rows.residual[:V][views] + self.X[:V][views] @ coefficients
