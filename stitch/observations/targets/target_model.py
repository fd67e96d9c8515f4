"""The linear model of labelled points and probes: rows beside hand-eye and landmarks; every view is a block."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.frames import Array, Indices, Mask
from stitch.measurement.measurement import Measurement
from stitch.model.forward import corrected_capture
from stitch.model.model import Model, Term, sizes_of, stack_parameters, values_of
from stitch.observations.linear_model import CoefficientPrior, LinearModel, PointSums, Response
from stitch.observations.pose_errors import joint_offset_twists, mean_square_per_axis
from stitch.observations.targets.rows import (
    Drawing,
    Landmarks,
    TargetRows,
    effect_columns,
    effect_rows,
    initial_landmarks,
    mixed_model_of_rows,
    target_rows,
)
from stitch.statistics.folds import JointEnd, grouped_folds, joint_ends
from stitch.statistics.least_squares import BlockLeastSquares, equilibrated, independent
from stitch.statistics.parameter_selection import UNSEEN
from stitch.statistics.reml import fit_variances, whitener

# What the labelled points of one session say under a fitted model.


@dataclass(frozen=True)
class TargetModelFit:
    """Model, places of the targets and scatter of the poses; lengths in length_unit, angles in rad."""

    model: Model
    inflation: float  # factor on the covariance that views left out ask for, ≥ 1
    landmarks: Landmarks
    landmarks_covariance: Array  # (U, U)
    variances: Array  # (3,) of rotation scatter, translation scatter, factor on the sensor's noise
    rows: TargetRows  # at the solution
    heldout: Array  # (V, S) distances of targets predicted without their own views; NaN where none was seen
    history: tuple[float, ...]  # 3D rms per iteration

    @property
    def rms(self) -> float:
        """3D root mean square over all targets of all views."""
        return rms_of(self.rows.distances(self.rows.residual))

    @property
    def heldout_rms(self) -> float:
        """The same for targets predicted without their own views."""
        return rms_of(self.heldout)

    @property
    def noise_floor(self) -> float:
        """What the sensor's own noise would leave of it if every pose were perfect."""
        noise = self.rows.noise[: len(self.rows.lever), : self.rows.positions]
        return float(np.sqrt(3 * np.mean(noise[noise > 0])))

    @property
    def target_rms(self) -> Array:
        """(K,) rms distance of the views from every target; NaN for one that nobody sees."""
        s, distances = self.rows.sightings, self.rows.distances(self.rows.residual)
        return np.array(
            [rms_of(distances[s.used & (s.target == k)]) if n else np.nan for k, n in enumerate(s.view_counts)]
        )

    @property
    def view_squares(self) -> Array:
        """(V,) mean square distance of the targets in every view; NaN where none was seen: no perfect view."""
        distances = self.rows.distances(self.rows.residual)
        seen = np.isfinite(distances).sum(axis=1)
        return np.where(seen > 0, np.nansum(distances**2, axis=1) / np.maximum(seen, 1), np.nan)

    @property
    def single_view_targets(self) -> tuple[str, ...]:
        """Targets that say nothing of the poses: fewer than two views show them, and no other run knows them."""
        s = self.rows.sightings
        few = [name for name, n in zip(s.targets, s.view_counts, strict=True) if n < 2]
        return tuple(name for name in few if name not in self.model.targets)

    @property
    def uninformative(self) -> bool:
        """True if no target says anything of the poses."""
        return len(self.single_view_targets) == len(self.rows.sightings.targets)

    @property
    def landmark_sigmas(self) -> Array:
        """(K, 3) of the targets' places."""
        K = len(self.landmarks.positions)
        return np.sqrt(np.maximum(np.diag(self.landmarks_covariance)[: 3 * K], 0)).reshape(K, 3)

    def __repr__(self) -> str:
        return f"TargetFit({len(self.landmarks.positions)} targets, rms {self.rms:.3g}, {self.model!r})"


def rms_of(distances: Array) -> float:
    """Root mean square, NaN left out."""
    return float(np.sqrt(np.nanmean(distances**2)))


# A model of labelled points tried in the linear approximation.

# Views of largest influence on the estimates: if one alone carries them, it is among these.
_CARRIERS = 20


@dataclass(frozen=True)
class TargetTrial:
    """Columns X (B, m, k) of rows with the covariance of the null, fitted as a run fits them."""

    rows: TargetRows
    covariance: Array  # (B, m, m)
    X: Array
    prior: CoefficientPrior | None = None

    @cached_property
    def blocks(self) -> BlockLeastSquares:
        zero = np.zeros(self.X.shape[2])
        precision, middle = (zero, zero) if self.prior is None else (self.prior.precision, self.prior.mean)
        return BlockLeastSquares(-self.rows.residual, self.X, self.covariance, precision, precision * middle)

    def solve(self, left_out: Indices | None = None) -> Array:
        """Coefficients (k,) without some views."""
        return self.blocks.solve(left_out)

    def squares(self, coefficients: Array) -> Array:
        """(V,) squares of the 3D distances of a view's targets."""
        return np.asarray(np.nansum(self.rows.distances(self.rows.residual + self.X @ coefficients) ** 2, axis=1))

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """Of the distances at the left-out views' targets, in units of the sensor's noise: each is seen as it is."""
        own = self.rows.used[left_out, : self.rows.positions]
        rest = (self.rows.residual + self.X @ coefficients)[left_out, : self.rows.positions]
        return float(np.sum(rest[own] ** 2 / self.rows.noise[left_out, : self.rows.positions][own]))

    def influential_views(self, coefficients: Array) -> Indices:
        """(n,) the views without which the coefficients would move most, to first order."""
        b = self.blocks
        scaled, unit = equilibrated(b.information)
        moves = b.residual_vectors(coefficients) * unit @ np.linalg.pinv(scaled, rcond=1e-14, hermitian=True)
        sizes = np.linalg.norm(moves[: len(self.rows.lever)], axis=1)
        return np.asarray(np.argsort(-sizes, kind="stable")[:_CARRIERS], np.int64)


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
