"""The linear model of an observation in rows: six numbers a view, a trial on all its rows."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.effects.contract import EFFECTS, missing_need, of_each_scanner
from stitch.effects.empirical import empirical_effects
from stitch.model.forward import moves_points, pose_derivatives
from stitch.model.model import Model, Term, grid_terms, sizes_of, stack_parameters, values_of
from stitch.numerics.common_covariance import common_covariance
from stitch.numerics.folds import JointEnd, joint_ends
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import equilibrated, independent, solve_in_units, symmetric_inverse
from stitch.numerics.parameter_selection import UNSEEN
from stitch.numerics.reml import NOISE, MixedModel, fit_variances, flatten_blocks, whitener
from stitch.observations.linear_model import CoefficientPrior, LinearModel, Observation, PointSums, Response
from stitch.observations.pose_errors import joint_offset_twists, mean_square_per_axis
from stitch.observations.row_reduction import RowReduction, by_view, reduction_of
from stitch.observations.rows import Rows
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement

# Views of largest influence on the estimates that are tested: if a single one decides them, it is among these.
_CARRIERS = 20


@dataclass(frozen=True)
class ReducedRows(Observation):
    """Rows of V views reduced to C blocks of d numbers: a block per view, then blocks of no view's own."""

    capture: Capture  # of the rows, without the effects in use
    centre: Array  # (3,) of the rows, reference frame
    rows: Rows
    reduction: RowReduction

    @property
    def reach(self) -> float:
        """Median distance, length_unit, from the flange to what is seen: by so much a radian of the flange moves it."""
        return self.rows.reach

    @property
    def numbers_per_view(self) -> int:
        """d, the number of reduced numbers in a view's block."""
        return int(self.reduction.of_views.shape[1])

    def from_twists(self, moved: Array) -> Array:
        """Return the change (C·d, P) of the reduced numbers by left twists (6V, P) of the views about the centre."""
        return flatten_blocks(self.reduction.reduce_twists(self.rows.lever @ moved.reshape(-1, 6, moved.shape[1])))

    def responses(self, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Response]:
        """Return per term how the C·d reduced numbers answer to its P parameters, (C·d, P).

        Effects that move a view as a whole answer by twists of the views, those that move points by rows of the points.
        """
        of_views = pose_derivatives(measurement, model, [t for t in terms if not moves_points([t])], self.centre)
        out = list[Response]()
        for term in terms:
            if moves_points([term]):
                columns = flatten_blocks(self.reduction.reduce(self.rows.effect_columns(measurement, model, [term])[0]))
            else:
                moved = next(of_views)
                columns = self.from_twists(moved.reshape(len(moved), -1).T)
            out.append(Response(columns))
        return out

    def trial(self, linear: LinearModel, response: Array, points: PointSums | None = None) -> "RowTrial":
        """Return the trial of a model with columns `response` (C·d, k); `points` are not used."""
        return RowTrial(self, linear, linear.in_blocks(response))

    def affected_squares(self, views: Indices) -> Mask:
        """Return a mask (V,) of the views themselves: each has a sum of squares of its own."""
        mask: Mask = np.asarray(np.isin(np.arange(len(self.rows.lever)), views))
        return mask

    def joint_ends(self, joints: Array) -> list[JointEnd]:
        """Return both ends of every joint's range, for joints (V, n) rad, of the views that show anything."""
        return joint_ends(joints, np.flatnonzero(self.rows.used.any(axis=1)))

    def part_displacements(self, numbers: Array) -> Array:
        """Return the motion (V, 3) of a view that makes its numbers by shifts alone; zero where it shows nothing."""
        left = numbers.reshape(-1, self.numbers_per_view)[: len(self.rows.lever), :, None]
        return (self._of_shifts @ left)[..., 0]

    @cached_property
    def _of_shifts(self) -> Array:
        """(V, 3, d) from the numbers of a view to the shift of it, length_unit, that makes them by least squares."""
        V = len(self.rows.lever)
        return np.linalg.pinv(self.reduction.reduce_twists(self.rows.lever[..., 3:])[:V]).astype(float)

    def mixed_model(self, A: Array) -> MixedModel:
        """Return the reduced observations as C blocks of d numbers, with their variance components.

        Components are rotation and translation scatter of the flange, and the sensor's noise. Landmarks that the
        reduction has eliminated each use up one independent number.

        Args:
            A: (C, d, a) columns of the free mean.
        """
        rows, reduction = self.rows, self.reduction
        noise, fixed = reduction.present
        scattered = [reduction.reduce_twists(moved) for moved in rows.scattered]
        diagonal = noise[..., None] * np.eye(noise.shape[1])
        components = [moved @ moved.transpose(0, 2, 1) for moved in scattered]
        eliminated = rows.landmarks.shape[2] - reduction.kept.shape[1]
        return MixedModel(
            -reduction.reduce(rows.residual[..., None])[..., 0],
            A,
            np.array([*components, diagonal]),
            fixed[..., None] * np.eye(noise.shape[1]),
            rows.independent - eliminated,
            common=common_covariance([moved[: len(rows.lever)] for moved in scattered], noise, fixed),
            noise_only=reduction.noise_only,
        )


def row_model(measurement: Measurement, model: Model, rows: Rows) -> LinearModel:
    """Return the linear model of what a session shows in rows: hand-eye, landmarks and effects in use are free.

    The variances are fitted twice: with all effects in use, which tells how clearly the rows show each parameter; then
    without those that are not shown, if there are any.

    Args:
        measurement: with the sightings that count, others masked.
        model: about which the rows are linearised.
    """
    reduction = _reduction(measurement, model, rows)
    observation = ReducedRows(rows.capture, rows.centre, rows, reduction)
    base = reduction.reduce(np.concatenate([rows.hand_eye, rows.landmarks @ reduction.kept], axis=2))
    effects = reduction.reduce(rows.columns_in_use(measurement, model))
    sizes, values = sizes_of(model.terms), values_of(model.terms)
    # Parameters that the fit left at zero are not in the model.
    used = np.array([p.value != 0 and not p.discrete for p in stack_parameters(model.terms)], bool)
    with_all = observation.mixed_model(np.concatenate([base, effects[..., used]], axis=2))
    null = fit_variances(with_all, both_starts=True)
    inverse_root = whitener(with_all, null.variances)
    white_base, white_effects = flatten_blocks(inverse_root @ base), flatten_blocks(inverse_root @ effects)
    seen = used & independent(white_base, white_effects * used, sizes, 1 / UNSEEN)
    A = np.concatenate([base, effects[..., seen]], axis=2)
    mixed = observation.mixed_model(A)
    if (seen != used).any():
        null = fit_variances(mixed, both_starts=True)
    offsets = joint_offset_twists(measurement, model, rows.centre)
    per_joint = np.zeros(2) if offsets is None else mean_square_per_axis(offsets, [measurement], [rows.centre])
    return LinearModel(
        measurement,
        model,
        observation,
        flatten_blocks(A),
        sizes=np.append(np.full(base.shape[2], np.inf), sizes[seen]),
        values=np.append(np.zeros(base.shape[2]), values[seen]),
        mixed=mixed,
        null=null,
        offsets=None if offsets is None else observation.from_twists(offsets).reshape(*mixed.z.shape, -1),
        flange_per_joint=per_joint,
    )


def _reduction(measurement: Measurement, model: Model, rows: Rows) -> RowReduction:
    """Return the reduction of the rows to fewer numbers that loses nothing of any effect that moves points.

    Counted are the effects in use and all of the library that this session could have, since diagnosis may ask them.
    """
    views = measurement.views
    effects = [e for e in EFFECTS.values() if e.place in ("sensor", "shape")] + empirical_effects(views)
    terms = [term for term in model.terms if moves_points([term])]
    for effect in of_each_scanner(views, effects):
        if not missing_need(measurement, effect):
            terms += grid_terms(measurement, effect)
    of_points = [np.zeros((*rows.residual.shape, 0)), *rows.effect_columns(measurement, model, terms)]
    # Rows without the sensor's noise that answer to landmarks: nominal places, whose variance is known.
    known = np.where((rows.noise == 0) & rows.landmarks.any(axis=2), rows.fixed, 0.0)
    return reduction_of(rows.residual, rows.lever, rows.landmarks, rows.noise, known, np.concatenate(of_points, axis=2))


@dataclass(frozen=True)
class RowTrial:
    """Columns with the covariance of the null, fitted as a run fits them: on all rows, each by its own variance.

    All U unknowns of what is seen are free. They are eliminated first (Schur complement), so that what is solved is as
    small as hand-eye and effects; of coefficients they are the first, and the columns that stand for them are unused.
    """

    observation: ReducedRows
    linear: LinearModel
    X: Array  # (C, d, k)

    @cached_property
    def _others(self) -> Indices:
        """(p,) indices of the columns that are no landmarks: the hand-eye's six, and all after the landmarks."""
        at = 6 + self.observation.reduction.kept.shape[1]
        return np.delete(np.arange(self.X.shape[2]), slice(6, at))

    @cached_property
    def _rows(self) -> Array:
        """(B, m, p + 1) the columns of `_others`, then the observations z, both divided by the sigma of each row."""
        rows, reduction = self.observation.rows, self.observation.reduction
        z = -reduction.per_sigma * rows.residual
        return np.concatenate([reduction.expand(self.X[..., self._others]), z[..., None]], axis=2)

    @cached_property
    def _weights(self) -> Array:
        """(B, m) weights of the rows, 1/variance in squares of the rows' sigmas; 0 of absent rows.

        A row of a view varies by the sensor's noise and by the scatter of the view's pose. Its correlation with other
        rows is left out, as in the fit of a run.
        """
        per_sigma, Q = self.observation.reduction.per_sigma, self.observation.reduction.of_views
        noise = self.linear.null.variances[NOISE]
        pose_scatter = self.linear.covariance[: len(Q)] - noise * np.eye(Q.shape[1])
        variance = np.ones(per_sigma.shape)
        variance[: len(Q)] = noise + np.einsum("vdm,vde,vem->vm", Q, pose_scatter, Q, optimize=True)
        return np.where(per_sigma > 0, 1 / variance, 0.0)

    def _sums(self, blocks: slice | Indices) -> tuple[Array, Array, Array]:
        """Return weighted sums over the rows of some blocks: LᵀWL (U, U), LᵀWX (U, p + 1) and XᵀWX (p + 1, p + 1).

        L are the columns of the U unknown landmarks, X those of `_rows`, with the observations as the last one.
        """
        X, weights = flatten_blocks(self._rows[blocks]), self._weights[blocks].reshape(-1, 1)
        B, m = self._weights.shape
        L = self.observation.reduction.points[(np.arange(B)[blocks][:, None] * m + np.arange(m)).ravel()]
        weighted = weights * X
        return (L.T @ L.multiply(weights).tocsr()).toarray(), L.T @ weighted, X.T @ weighted

    @cached_property
    def _all(self) -> tuple[Array, Array, Array]:
        """The sums of `_sums` over all blocks."""
        return self._sums(slice(None))

    def solve(self, left_out: Indices | None = None) -> Array:
        """Return the coefficients (U + k,) by weighted least squares without a prior, fitted without some views."""
        nothing = np.zeros(self.X.shape[2])
        return self.solve_each([CoefficientPrior(nothing, nothing)], left_out)[0]

    def solve_each(self, priors: Sequence[CoefficientPrior], left_out: Indices | None = None) -> list[Array]:
        """Return coefficients (U + k,) by weighted least squares under each prior: U landmarks, then the k columns.

        The normal equations are those of the landmarks L and the columns X. The landmarks are eliminated (Schur
        complement), the rest is solved under the prior, and the landmarks follow.

        Args:
            priors: each of the first coefficients of the columns; those beyond it are held at zero.
            left_out: numbers of views whose rows are not counted; None: all count.
        """
        LL, LX, XX = self._all
        if left_out is not None:
            less_LL, less_LX, less_XX = self._sums(np.asarray(left_out, np.int64))
            LL, LX, XX = LL - less_LL, LX - less_LX, XX - less_XX
        # What the landmarks are for given columns, and the Schur complement of theirs.
        landmarks = self._inverse(LL) @ LX
        schur = XX - LX.T @ landmarks
        U = len(LL)
        solutions = list[Array]()
        for prior in priors:
            others = self._others[self._others < len(prior.precision)]
            p = len(others)
            precision = prior.precision[others]
            unit = equilibrated(self._all[2][:p, :p] + np.diag(precision))[1]
            x = solve_in_units(schur[:p, :p] + np.diag(precision), schur[:p, -1] + precision * prior.mean[others], unit)
            solution = np.zeros(U + self.X.shape[2])
            solution[:U] = landmarks[:, -1] - landmarks[:, :p] @ x
            solution[U + others] = x
            solutions.append(self._with_kept(solution))
        return solutions

    def _inverse(self, LL: Array) -> Array:
        """Return the inverse (U, U) of the landmarks' normal matrix (U, U); zero for a landmark that no view shows."""
        diagonal = np.diag(LL)
        if (np.diag(diagonal) == LL).all():
            shown = diagonal > 1e-12 * np.diag(self._all[0])
            return np.diag(np.where(shown, 1 / np.where(shown, diagonal, 1.0), 0.0))
        return symmetric_inverse(LL)

    def _with_kept(self, solution: Array) -> Array:
        """Return a solution (U + k,) in which the columns of landmarks, so far zero, have their coefficients too.

        The reduced model has r columns for combinations of the U landmarks: their coefficients follow from these.
        """
        shares = self.observation.reduction.shares
        count, unknowns = shares.shape
        solution[unknowns + 6 : unknowns + 6 + count] = shares @ solution[:unknowns]
        return solution

    def squares(self, coefficients: Array, units: Indices | Mask | None = None) -> Array:
        """Return the sums (V,) of each view's squared residual distances, length_unit², under coefficients (U + k,).

        Args:
            units: views whose sums are returned; None: all.
        """
        rows = self.observation.rows
        units = np.arange(len(rows.lever)) if units is None else units
        sigmas = np.sqrt(rows.noise[: len(rows.lever)] * rows.distances_used)[units]
        return np.sum((self._rest(coefficients, units) * sigmas) ** 2, axis=1)

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """Return the χ² of the residuals of left-out views under coefficients (U + k,).

        Directions in which a view's pose scatters are whitened by its covariance; all others are divided by the noise.
        """
        rest = self._rest(coefficients, left_out)[..., None]
        of_pose = self.observation.reduction.of_views[left_out] @ rest
        beyond = float(np.sum(rest**2) - np.sum(of_pose**2)) / self.linear.null.variances[NOISE]
        return float(np.sum((self.linear.whitening[left_out] @ of_pose) ** 2)) + beyond

    def influential_views(self, coefficients: Array) -> Indices:
        """Return at most `_CARRIERS` views (n,), first those without which the coefficients would move most.

        The motion is, to first order, H⁻¹ g_v, with H the normal matrix without the landmarks and g_v the gradient of
        view v alone.
        """
        LL, LX, XX = self._all
        landmarks = self._inverse(LL) @ LX[:, :-1]
        V, m = len(self.observation.rows.lever), self._weights.shape[1]
        weighted = (self._weights[:V] * -self._rest(coefficients, np.arange(V)))[:, None]
        gradients = (weighted @ self._rows[:V, :, :-1])[:, 0]
        of_landmarks = by_view(weighted) @ self.observation.reduction.points[: V * m]
        gradients = gradients - of_landmarks @ landmarks
        scaled, unit = equilibrated(XX[:-1, :-1] - LX[:, :-1].T @ landmarks)
        motions = np.linalg.norm(gradients * unit @ np.linalg.pinv(scaled, rcond=1e-14, hermitian=True), axis=1)
        return np.argsort(-motions, kind="stable")[:_CARRIERS].astype(np.int64)

    def _rest(self, coefficients: Array, views: Indices | Mask) -> Array:
        """Return the residuals (n, m) of n of the views under coefficients (U + k,), in units of the rows' sigmas."""
        V, m = len(self.observation.rows.lever), self._weights.shape[1]
        points = self.observation.reduction.points
        placed = (points[: V * m] @ coefficients[: points.shape[1]]).reshape(V, m)
        x = np.append(coefficients[points.shape[1] + self._others], -1.0)
        rest: Array = self._rows[:V][views] @ x + placed[views]
        return rest
