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

# Views of largest influence on the estimates: if one alone carries them, it is among these.
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
        """Distance of what is seen from the flange: what a turn of it moves the points by."""
        return self.rows.reach

    @property
    def numbers_per_view(self) -> int:
        """Those of a view's block."""
        return int(self.reduction.of_views.shape[1])

    def from_twists(self, moved: Array) -> Array:
        """Return numbers (C·d, P) of left twists (6V, P) of the views about the centre."""
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
        """Return a model with columns (C·d, k)."""
        return RowTrial(self, linear, linear.in_blocks(response))

    def affected_squares(self, views: Indices) -> Mask:
        """Return the views themselves, (V,) bool."""
        mask: Mask = np.asarray(np.isin(np.arange(len(self.rows.lever)), views))
        return mask

    def joint_ends(self, joints: Array) -> list[JointEnd]:
        """Return both ends of every joint's range, of the views that show anything."""
        return joint_ends(joints, np.flatnonzero(self.rows.used.any(axis=1)))

    def part_displacements(self, numbers: Array) -> Array:
        """Return the motion (V, 3) of a view that makes its numbers by shifts alone; zero where it shows nothing."""
        left = numbers.reshape(-1, self.numbers_per_view)[: len(self.rows.lever), :, None]
        return (self._of_shifts @ left)[..., 0]

    @cached_property
    def _of_shifts(self) -> Array:
        """(V, 3, d) shifts of the views that make their numbers."""
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
    extra = rows.columns_in_use(measurement, model)
    reduction = _reduction(measurement, model, rows)
    observation = ReducedRows(rows.capture, rows.centre, rows, reduction)
    base = reduction.reduce(np.concatenate([rows.hand_eye, rows.landmarks @ reduction.kept], axis=2))
    extra = reduction.reduce(extra)
    sizes, values = sizes_of(model.terms), values_of(model.terms)
    # Parameters that the fit left at zero are not in the model.
    used = np.array([p.value != 0 and not p.discrete for p in stack_parameters(model.terms)], bool)
    whole = observation.mixed_model(np.concatenate([base, extra[..., used]], axis=2))
    null = fit_variances(whole, both_starts=True)
    half = whitener(whole, null.variances)
    white_extra = flatten_blocks(half @ extra)
    seen = used & independent(flatten_blocks(half @ base), white_extra * used, sizes, 1 / UNSEEN)
    A = np.concatenate([base, extra[..., seen]], axis=2)
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
        """(p,) numbers of the columns that are no landmarks: the hand-eye's six, and all after the landmarks."""
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
        reduction = self.observation.reduction
        views, noise = len(reduction.of_views), self.linear.null.variances[NOISE]
        beyond = self.linear.covariance[:views] - noise * np.eye(reduction.of_views.shape[1])
        Q = reduction.of_views
        variance = np.ones(reduction.per_sigma.shape)
        variance[:views] = noise + np.einsum("vdm,vde,vem->vm", Q, beyond, Q, optimize=True)
        return np.where(reduction.per_sigma > 0, 1 / variance, 0.0)

    def _sums(self, blocks: slice | Indices) -> tuple[Array, Array, Array]:
        """Return weighted sums over the rows of some blocks: LᵀWL (U, U), LᵀWX (U, p + 1) and XᵀWX (p + 1, p + 1).

        L are the columns of the U unknown landmarks, X those of `_rows`, with the observations as the last one.
        """
        rows, weights = self._rows[blocks], self._weights[blocks].ravel()
        B, m = self._weights.shape
        points = self.observation.reduction.points[(np.arange(B)[blocks][:, None] * m + np.arange(m)).ravel()]
        rows = flatten_blocks(rows)
        weighted = weights[:, None] * rows
        return (points.T @ points.multiply(weights[:, None]).tocsr()).toarray(), points.T @ weighted, rows.T @ weighted

    @cached_property
    def _all(self) -> tuple[Array, Array, Array]:
        return self._sums(slice(None))

    def solve(self, left_out: Indices | None = None) -> Array:
        """Return coefficients (U + k,) without some views."""
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
        unknowns, across, own = self._all
        if left_out is not None:
            some = self._sums(np.asarray(left_out, np.int64))
            unknowns, across, own = unknowns - some[0], across - some[1], own - some[2]
        inverse = self._inverse(unknowns)
        held = inverse @ across
        left = own - across.T @ held
        solutions = list[Array]()
        for prior in priors:
            others = self._others[self._others < len(prior.precision)]
            p = len(others)
            precision = prior.precision[others]
            unit = equilibrated(self._all[2][:p, :p] + np.diag(precision))[1]
            x = solve_in_units(left[:p, :p] + np.diag(precision), left[:p, -1] + precision * prior.mean[others], unit)
            solution = np.zeros(len(unknowns) + self.X.shape[2])
            solution[: len(unknowns)] = held[:, -1] - held[:, :p] @ x
            solution[len(unknowns) + others] = x
            solutions.append(solution)
        return [self._with_kept(solution) for solution in solutions]

    def _inverse(self, unknowns: Array) -> Array:
        """(U, U) inverse of the landmarks' normal matrix (U, U); zero for a landmark that no view shows."""
        diagonal = np.diag(unknowns)
        if (unknowns == np.diag(diagonal)).all():
            shown = diagonal > 1e-12 * np.diag(self._all[0])
            return np.diag(np.where(shown, 1 / np.where(shown, diagonal, 1.0), 0.0))
        return symmetric_inverse(unknowns)

    def _with_kept(self, solution: Array) -> Array:
        """Return a solution (U + k,) in which the columns of landmarks, so far zero, have their coefficients too.

        The reduced model has r columns for combinations of the U landmarks: their coefficients follow from these.
        """
        shares = self.observation.reduction.shares
        count, unknowns = shares.shape
        solution[unknowns + 6 : unknowns + 6 + count] = shares @ solution[:unknowns]
        return solution

    def squares(self, coefficients: Array, units: Indices | Mask | None = None) -> Array:
        """(V,) sums of the squares of a view's residual distances, length_unit², under coefficients (U + k,).

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
        """(n,) at most `_CARRIERS` views, in the order of how far the coefficients move without each, to first order.

        It is the norm of H⁻¹ g_v, with H the normal matrix without the landmarks and g_v the gradient of view v alone.
        """
        unknowns, across, own = self._all
        held = self._inverse(unknowns) @ across[:, :-1]
        V, m = len(self.observation.rows.lever), self._weights.shape[1]
        weighted = (self._weights[:V] * -self._rest(coefficients, np.arange(V)))[:, None]
        pulls = (weighted @ self._rows[:V, :, :-1])[:, 0]
        of_points = by_view(weighted) @ self.observation.reduction.points[: V * m]
        pulls = pulls - of_points @ held
        scaled, unit = equilibrated(own[:-1, :-1] - across[:, :-1].T @ held)
        sizes = np.linalg.norm(pulls * unit @ np.linalg.pinv(scaled, rcond=1e-14, hermitian=True), axis=1)
        return np.argsort(-sizes, kind="stable")[:_CARRIERS].astype(np.int64)

    def _rest(self, coefficients: Array, views: Indices | Mask) -> Array:
        """(n, m) residuals of n of the views under coefficients (U + k,), in units of the rows' sigmas."""
        V, m = len(self.observation.rows.lever), self._weights.shape[1]
        points = self.observation.reduction.points
        placed = (points[: V * m] @ coefficients[: points.shape[1]]).reshape(V, m)
        x = np.append(coefficients[points.shape[1] + self._others], -1.0)
        rest: Array = self._rows[:V][views] @ x + placed[views]
        return rest
