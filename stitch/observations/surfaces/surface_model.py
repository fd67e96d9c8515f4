"""The linear model of overlapping surfaces: free-network views, read through the visible directions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stitch.model.model import Model, Term, sizes_of, values_of
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import column_space, fit_columns, independent
from stitch.numerics.reml import MixedModel, VarianceFit, at_variances, fit_variances
from stitch.observations.linear_model import (
    CoefficientPrior,
    LinearModel,
    Observation,
    PointSums,
    Response,
    with_pose_errors,
)
from stitch.observations.pose_errors import MANY_VIEWS, prior_pose_errors
from stitch.observations.surfaces.effect_columns import PointGram, view_columns, view_responses
from stitch.observations.surfaces.hand_eye_fit import (
    ReducedPoses,
    hand_eye_jacobian,
    hand_eye_mixed_model,
    reduce_poses,
)
from stitch.observations.surfaces.normal_equations import pair_squares
from stitch.observations.surfaces.scanner_errors import field_scatter, scale_scatter, smooth_errors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement
from stitch.system.threads import remembered

# A parameter whose column, at its plausible size, is shorter than this many sigmas is left out of the mean.
_UNSEEN = 0.25


@dataclass(frozen=True)
class SurfaceTrial:
    """A trial of k parameters on overlapping surfaces: twists of the views, and sums over pairs without new matches."""

    linear: LinearModel
    unconstrained: UnconstrainedPoses
    X: Array  # (6V, k) left twists of the views per unit of each parameter
    points: PointSums | None = None  # sums of the last parameters, if these move points within a view

    def solve(self, left_out: Indices | None = None) -> Array:
        """Return the coefficients (k,) by generalised least squares, fitted without some views (indices)."""
        return self._solve(self._white_X, self.linear.white_z, left_out)

    def solve_each(self, priors: Sequence[CoefficientPrior], left_out: Indices | None = None) -> list[Array]:
        """Return coefficients (k,) by generalised least squares under each prior, without some views.

        Args:
            priors: each of the first coefficients; those beyond it are held at zero.
            left_out: numbers of views that are not counted; None: all count.
        """
        white, solutions = self._white_X, []
        for prior in priors:
            # A normal prior is k more observations of the coefficients.
            per_sigma, k = np.sqrt(prior.precision), len(prior.precision)
            z = np.append(self.linear.white_z, per_sigma * prior.mean)
            solution = self._solve(np.vstack([white[:, :k], np.diag(per_sigma)]), z, left_out)
            solutions.append(np.pad(solution, (0, white.shape[1] - k)))
        return solutions

    def _solve(self, white: Array, z: Array, left_out: Indices | None) -> Array:
        """Return the coefficients (k,) of whitened columns (n, k) for observations z (n,), without some views."""
        k = white.shape[1]
        if left_out is not None:
            # A view is left out by letting it move freely: six more columns each.
            free = self._free(left_out)
            white = np.hstack([white, np.vstack([free, np.zeros((len(z) - len(free), free.shape[1]))])])
        return fit_columns(white, z)[:k]

    def squares(self, coefficients: Array, units: Indices | Mask | None = None) -> Array:
        """Return Σ w e² (pairs,), length_unit², with the views where coefficients (k,) put them, without new matches.

        Args:
            units: pairs whose sums are returned; None: all.
        """
        g, points = self.unconstrained.overlaps.gram, self.points
        of_views = self.X.shape[1] - (points.residual.shape[1] if isinstance(points, PointGram) else 0)
        # The sums are at the free-network poses, which are `unconstrained.twists` away from the model's.
        twists = (self.X[:, :of_views] @ coefficients[:of_views]).reshape(-1, 6) - self.unconstrained.twists
        squares = pair_squares(g, twists)
        if isinstance(points, PointGram):
            # Effects that move points change e itself and do not move the views.
            theta = coefficients[of_views:]
            difference = twists[g.pairs[:, 0]] - twists[g.pairs[:, 1]]
            cross = np.einsum("pi,pik,k->p", difference, points.vector, theta)
            quadratic = np.einsum("k,pkl,l->p", theta, points.square, theta)
            squares = squares + 2 * points.residual @ theta + 2 * cross + quadratic
        return squares if units is None else squares[units]

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """Return the χ² of the left-out views: squares of the whitened residual in the directions that these move."""
        directions = column_space(self._free(left_out))
        rest = self.linear.white_z - self._white((self.X @ coefficients)[:, None])[:, 0]
        return float(np.sum((directions.T @ rest) ** 2))

    def influential_views(self, coefficients: Array) -> Indices:
        """Return all views (V,): each has many correspondences, so that any may decide."""
        return np.arange(self.unconstrained.overlaps.gram.views, dtype=np.int64)

    @cached_property
    def _white_X(self) -> Array:
        """(n, k) the columns X, whitened."""
        return self._white(self.X)

    def _white(self, response: Array) -> Array:
        """Return the whitened reduced columns (n, P) of twists (6V, P)."""
        return self.linear.whiten(self.linear.reduce(response))

    def _free(self, views: Indices) -> Array:
        """Return the whitened unit twists (n, 6k) of k views, which let these move freely."""
        return white_twists(self.linear)[:, (6 * np.asarray(views)[:, None] + np.arange(6)).ravel()]


@dataclass(frozen=True)
class SurfaceObservation(Observation):
    """V free-network views: the observation's coordinates are twists (6V, P), reduced to their n visible directions."""

    capture: Capture  # without the effects in use
    unconstrained: UnconstrainedPoses
    reduced_poses: ReducedPoses
    centre: Array  # (3,) of the overlaps, reference frame
    scanner_errors: list[tuple[PointGram, float]]  # a scanner each, of `smooth_errors`

    @property
    def reach(self) -> float:
        """Rms lever, length_unit, of the correspondences about the centre."""
        return self.unconstrained.overlaps.gram.lever

    def from_twists(self, moved: Array) -> Array:
        """Return the visible directions (n, P) of twists (6V, P), which are the observation's own coordinates."""
        return self.reduce(moved)

    def responses(self, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Response]:
        """Return per term the twists (6V, P) per unit of its parameters, and sums over pairs if it moves points."""
        return view_responses(measurement, model, terms, self.unconstrained)

    def reduce(self, response: Array) -> Array:
        """Return the visible directions (n, P) of twists (6V, P)."""
        return self.reduced_poses.reduction @ response

    def expand(self, columns: Array) -> Array:
        """Return the shortest twists (6V, P) with the visible directions `columns` (n, P)."""
        return self.reduced_poses.expansion @ columns

    def trial(self, linear: LinearModel, response: Array, points: PointSums | None = None) -> SurfaceTrial:
        """Return the trial of a model with columns of twists `response` (6V, k); `points` are sums of the last."""
        return SurfaceTrial(linear, self.unconstrained, response, points)

    def affected_squares(self, views: Indices) -> Mask:
        """Return a mask (pairs,) of the pairs that one of the views is in."""
        mask: Mask = np.asarray(np.isin(self.unconstrained.overlaps.gram.pairs, views).any(axis=1))
        return mask

    def part_displacements(self, numbers: Array) -> Array:
        """Return the translations (V, 3) of the shortest twists with visible directions (n,), less their mean."""
        out = self.expand(numbers).reshape(-1, 6)[:, 3:]
        return out - out.mean(axis=0)


@remembered
def white_twists(linear: LinearModel) -> Array:
    """Return the whitened unit twists (n, 6V) of all views of a linear model of surfaces; kept for the model."""
    surfaces = surfaces_of(linear)
    assert surfaces is not None
    return linear.whiten(surfaces.reduced_poses.reduction)


def surfaces_of(linear: LinearModel) -> SurfaceObservation | None:
    """Return the overlapping surfaces that a linear model is of; None where something else was observed."""
    return linear.observation if isinstance(linear.observation, SurfaceObservation) else None


def surface_model(
    measurement: Measurement,
    model: Model,
    capture: Capture,
    unconstrained: UnconstrainedPoses,
    variances: Callable[[Sequence[str]], Array] | None = None,
) -> LinearModel:
    """Return the linear model of views that the overlaps alone have placed, about hand-eye and effects in use.

    Effects in use that these views hardly show (`_UNSEEN`) are left out of its mean. Of fewer than `MANY_VIEWS` views
    the covariance has the prior of pose errors.

    Args:
        capture: with the effects of the model taken out.
        unconstrained: its views moved by the overlaps alone, and the twists from the model's poses there.
        variances: for planned views, which show nothing yet: returns, for the names of further components, the
            variances of rotation scatter, translation scatter, noise and these. None: fitted to the views.
    """
    gram = unconstrained.overlaps.gram
    reduced = reduce_poses(capture, gram, unconstrained.twists, model.T_mount)

    def fit_null(mixed: MixedModel, names: Sequence[str] = ()) -> VarianceFit:
        """Return the variances of a model, fitted, or those of planned views; `names` are its further components."""
        return fit_variances(mixed, both_starts=True) if variances is None else at_variances(mixed, variances(names))

    twists = view_columns(measurement, model, unconstrained)
    effects = reduced.reduction @ twists
    sizes, values = sizes_of(model.terms), values_of(model.terms)
    scanner_errors = smooth_errors(measurement, unconstrained)
    scanner_covariance = _scanner_covariance(measurement, unconstrained, reduced, scanner_errors)
    # Which parameters in use the views show at all, under scatter, noise and the scanner's own errors.
    hand_eye_alone = replace(hand_eye_mixed_model(reduced), fixed=scanner_covariance)
    root = np.linalg.cholesky(hand_eye_alone.covariance(fit_null(hand_eye_alone).variances)[0])
    white_hand_eye = np.linalg.solve(root, reduced.hand_eye).astype(float)
    white_effects = np.linalg.solve(root, effects).astype(float)
    seen = independent(white_hand_eye, white_effects, sizes, _UNSEEN)
    mixed = replace(hand_eye_mixed_model(reduced, reduced.reduction @ twists[:, seen]), fixed=scanner_covariance)
    errors = None
    if measurement.views.count < MANY_VIEWS:
        errors = prior_pose_errors([measurement], model, [gram.centre]).project(reduced.reduction)
        mixed = with_pose_errors(mixed, errors)
    return LinearModel(
        measurement,
        model,
        SurfaceObservation(capture, unconstrained, reduced, gram.centre, scanner_errors),
        design=np.hstack([hand_eye_jacobian(capture, model.T_mount, gram.centre), twists[:, seen]]),
        sizes=np.append(np.full(6, np.inf), sizes[seen]),
        values=np.append(np.zeros(6), values[seen]),
        mixed=mixed,
        null=fit_null(mixed, () if errors is None else errors.names),
        pose_errors=errors,
        flange_per_joint=np.zeros(2) if errors is None else errors.flange_per_joint,
    )


def _scanner_covariance(
    measurement: Measurement,
    unconstrained: UnconstrainedPoses,
    reduced: ReducedPoses,
    scanner_errors: Sequence[tuple[PointGram, float]],
) -> Array:
    """Return the covariance (1, n, n) of the reduced poses by the smooth errors that every scanner has.

    With several scanners, by errors of their scales too.

    Args:
        scanner_errors: of each scanner, from `smooth_errors`.
    """
    errors = [field_scatter(scanner_errors, unconstrained)]
    if measurement.views.scanners:
        # Every pair of scanners differs in scale, and overlaps of their scans show it.
        errors.append(scale_scatter(measurement, unconstrained))
    columns = reduced.reduction @ np.hstack(errors)
    return (columns @ columns.T)[None]
