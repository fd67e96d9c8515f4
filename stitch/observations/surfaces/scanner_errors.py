"""Smooth errors of a scanner, over its field and over incidence: what every scanner has, and what the overlaps show.

A smooth error over the field and over incidence, a fraction of the noise, is in every view of every scanner. It repeats
from view to view, so no number of views averages it out, and it pretends to be a small effect of the scanner. Diagnosis
counts it as known scatter: what an effect must exceed. Hand-eye and effects are no better known than it lets them.

How large such errors are the overlaps tell: variance components by likelihood, one for each cause. The same in every
view is one cause, view by view another: a part that bends, a scanner that warms up or is read line by line while the
arm still moves. Each scan is sound then, and no motion of the views makes them meet. Errors beyond what every scanner
has: `field_error.py`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.optimize import minimize

from stitch.model.forward import PointSlopes
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.effect_columns import (
    PointGram,
    apparent_twists,
    stream_point_sums,
)
from stitch.observations.surfaces.hand_eye_fit import SCANNER_FIELD, SCANNER_SCALE
from stitch.observations.surfaces.normal_equations import Gram
from stitch.observations.surfaces.view_poses import (
    UnconstrainedPoses,
    solve_view_sums,
    sum_on_views,
    visible_step,
)
from stitch.session.measurement import Measurement

# Degree of the polynomials over the field; finer ones are added only where views may have errors of their own, so that
# these do not explain what all views share.
_DEGREE, _FINE_DEGREE = 3, 6
# The field ends where this share of the points lies within: corners are seen by few points.
_FIELD_QUANTILE = 0.98
_LEGENDRE_ORDERS = sorted(
    ((i, j) for i in range(_FINE_DEGREE + 1) for j in range(_FINE_DEGREE + 1) if 0 < i + j <= _FINE_DEGREE), key=sum
)
# Number of Legendre products up to `_DEGREE`, the coarse shapes, which come first.
COARSE = sum(sum(order) <= _DEGREE for order in _LEGENDRE_ORDERS)
# Number of all, coarse and finer.
FINE = len(_LEGENDRE_ORDERS)
# The causes of `view_error_likelihood`: over the field the same in every view, over incidence, over the field view by
# view.
SHARED, INCIDENCE, PER_VIEW = range(3)
# What every scanner has, as a share of its noise along the ray, and the spread of its logarithm; what is asked at all.
USUAL_SHARE, SHARE_SPREAD, SHARE_BOUNDS = 0.3, 0.7, (0.01, 10.0)
# Sizes over which a posterior is integrated, in that spread from the usual one.
_SIZE_SIGMAS = np.linspace(-4.0, 4.0, 33)
# Rms over the field, as a share of the scanner's noise along the ray: what an effect must exceed to be named. An
# effect of the scanner that is missing looks like a larger one, so this is not taken from the scans.
ALARM_SHARE = 0.5
# One standard deviation of a scanner's scale. Data sheets state length errors of 0.05 to 0.1 mm over half a metre
# (sphere spacing, VDI/VDE 2634) at the temperature of calibration; a few degrees more make as much.
SCALE_SIGMA = 2e-4
# Neighbouring distances share points and normals: so many times the variance of independent ones.
_CORRELATION_FACTOR = 3.0
# Combinations that the overlaps show less than this share of the clearest are rounding.
_ROUNDING_SHARE = 1e-6
# Normals are off by up to a tenth of a radian: what moves points less than that along them, squared, is their noise.
_NORMAL_NOISE = 0.01
# Of many views those that follow each other have errors in common: so many parts of a session at most.
_MAX_PARTS = 30


def rig_scanner_errors(
    measurements: Sequence[Measurement], unconstrained: Sequence[UnconstrainedPoses]
) -> dict[str, list[Array]]:
    """Return, by source and per session of a rig, left twists (6V, K) of the views by errors that all views share.

    Sources are the scanner's field and its scale; a column is one standard deviation of one error. The size of errors
    over the field is estimated from each session, that of the scale is `SCALE_SIGMA`.
    """
    sessions = list(zip(measurements, unconstrained, strict=True))
    return {
        SCANNER_FIELD: [field_scatter(smooth_errors(m, f), f, None) for m, f in sessions],
        SCANNER_SCALE: [scale_scatter(m, f) for m, f in sessions],
    }


def smooth_errors(measurement: Measurement, unconstrained: UnconstrainedPoses) -> list[tuple[PointGram, float]]:
    """Return for each scanner the sums over pairs for its smooth errors, and its noise (`sum_smooth_errors`).

    The errors are along the ray, over the field and over incidence, alike in all views of a scanner.
    """
    masks = measurement.views.scanners.masks(measurement.views.count)
    return [sum_smooth_errors(measurement, unconstrained, views=views) for views in masks]


def field_scatter(
    errors: Sequence[tuple[PointGram, float]], unconstrained: UnconstrainedPoses, share: float | None = ALARM_SHARE
) -> Array:
    """Return left twists (6V, K) that the views show for one standard deviation of each of K smooth errors.

    The errors are independent. Several scanners have K columns together, each its own; zeros where the scans are too
    few for a noise.

    Args:
        errors: of each scanner, from `smooth_errors`.
        share: rms of the errors as a share of the scanner's noise; None: estimated from the overlaps.
    """
    columns = []
    for sums, noise in errors:
        twists = apparent_twists(sums, unconstrained)
        if not np.isfinite(noise):
            sizes = np.zeros(twists.shape[1])
        elif share is not None:
            sizes = np.full(twists.shape[1], noise * share)
        else:
            field, incidence = shared_error_likelihood(sums, unconstrained, noise).map_shares
            sizes = noise * np.append(np.full(twists.shape[1] - 1, field), incidence)
        columns.append(twists * sizes)
    return np.hstack(columns)


def scale_scatter(measurement: Measurement, unconstrained: UnconstrainedPoses) -> Array:
    """Return left twists (6V, K) that the views show for one standard deviation of the scale of each of K scanners.

    A tracker or probe has no optics whose scale could be off: one column of zeros.
    """
    if not measurement.has_optics:
        return np.zeros((6 * len(unconstrained.poses), 1))
    scanners = measurement.views.scanners
    if not scanners:
        # Scans too large by the same share still fit each other, each shifted along the line from the part to its
        # scanner. So the twists are known without sums over correspondences.
        away = unconstrained.poses[:, :3, 3] - unconstrained.overlaps.gram.centre
        return SCALE_SIGMA * np.hstack([np.zeros_like(away), away]).reshape(-1, 1)
    # Scans of two scanners with different scales do not fit: where each comes to rest depends on where they overlap.
    capture = measurement.capture
    is_own = np.array(scanners.masks(len(capture.scans)))

    def scaled(v: int, index: Indices, normal: Array) -> Array:
        """Return how far what undoes a unit of each scanner's scale moves points of view v along normals, (N, K)."""
        return -np.sum(capture.scans[v].points[index] * normal, axis=1)[:, None] * is_own[:, v]

    def scaled_targets() -> Array:
        """Return the same for all labelled points, (K, V, S, 3)."""
        assert capture.sightings is not None
        return -np.nan_to_num(capture.sightings.points) * is_own[:, :, None, None]

    sums = stream_point_sums(unconstrained, capture.noise_factor, scaled, scaled_targets)
    return SCALE_SIGMA * apparent_twists(sums, unconstrained)


def sum_smooth_errors(
    measurement: Measurement,
    unconstrained: UnconstrainedPoses,
    point_effects: PointSlopes | None = None,
    per_view: bool = False,
    views: Mask | None = None,
) -> tuple[PointGram, float]:
    """Return the sums over pairs for parameters of smooth errors, and the median noise of the scans, length_unit.

    The parameters are, in this order: `COARSE` shapes along the ray over the field, one over incidence, and those of
    `point_effects`. Each counts what undoes the error, per unit. The noise is NaN if no scan is large enough for one.

    Args:
        point_effects: further effects that move points; None: none.
        per_view: True: each of the COARSE shapes has a coefficient of its own in each view, so that the sums hold them
            twice (`stream_point_sums`); and after incidence come further shapes that all views share
            (`error_shapes` with a standoff).
        views: (V,) bool, the views of the one scanner that has the errors; None: all have them.
    """
    capture = measurement.capture
    has_errors = np.ones(len(unconstrained.poses), bool) if views is None else views
    half = half_field(measurement, has_errors)
    further = point_effects or PointSlopes(measurement, ())
    scans = [scan for scan, has_them in zip(capture.scans, has_errors, strict=True) if has_them]
    standoff = None
    if per_view:
        standoff = float(np.median(np.concatenate([np.linalg.norm(s.points - s.eye, axis=1) for s in scans])))

    def of_points(v: int, index: Indices, normal: Array) -> Array:
        """Return how far points of view v move along normals (N, 3), scanner frame, per unit of each, (N, K)."""
        scan = capture.scans[v]
        away = scan.points.take(index, axis=0) - scan.eye
        shapes = error_shapes(away, measurement.scan_views[v].cosine[index], half, standoff)
        smooth = shapes.along_normals(normal) * has_errors[v]
        if not further.terms:
            return smooth
        return np.hstack([smooth, further.along(v, unconstrained.poses[v], index, normal).T])

    def of_targets() -> Array:
        """Return how unit errors move the labelled points (K, V, S, 3), sensor frame, length_unit."""
        assert capture.sightings is not None
        points, is_filled = capture.sightings.points, capture.sightings.target >= 0
        # An empty slot gets some ray; the incidence is taken as straight, since nobody knows it.
        rays = np.where(is_filled[..., None], points, [0.0, 0.0, 1.0]).reshape(-1, 3)
        moved = error_shapes(rays, np.ones(len(rays)), half, standoff).vectors.reshape(-1, *points.shape)
        smooth = np.where((is_filled & has_errors[:, None])[..., None], moved, 0.0)
        return np.concatenate([smooth, further.at_targets(unconstrained.poses)])

    sums = stream_point_sums(unconstrained, capture.noise_factor, of_points, of_targets, COARSE if per_view else 0)
    return sums, float(np.nanmedian([scan.noise for scan in scans]))


def half_field(measurement: Measurement, views: Mask | None = None) -> Array:
    """Return the half width and half height (2,) of the scanner's field, as |x/z| and |y/z| in its frame.

    They are the `_FIELD_QUANTILE` quantiles over all points, which leaves out the corners.

    Args:
        views: (V,) bool, the views that count; None: all.
    """
    scans = measurement.capture.scans
    of_views = scans if views is None else [scan for scan, counts in zip(scans, views, strict=True) if counts]
    away = np.concatenate([scan.points - scan.eye for scan in of_views])
    slopes = np.abs(away[:, :2] / away[:, 2:])
    return np.maximum(np.quantile(slopes, _FIELD_QUANTILE, axis=0), 1e-6)


@dataclass(frozen=True)
class ErrorShapes:
    """How N points move, scanner frame, per unit of each of K smooth errors: A along the ray, then 2B across it."""

    ray: Array  # (N, 3) unit vectors from the scanner's eye to the points
    along: Array  # (A, N) by each error along the ray
    across: Array  # (B, N) along the scanner's x by one error, and as far along its y by the next

    @property
    def vectors(self) -> Array:
        """(K, N, 3) the movements."""
        across = self.across[:, None, :, None] * np.eye(3)[:2, None]
        return np.concatenate([self.along[..., None] * self.ray, across.reshape(-1, *self.ray.shape)])

    def along_normals(self, normal: Array) -> Array:
        """Return the movements (N, K) along unit normals (N, 3), scanner frame."""
        by_ray = np.sum(self.ray * normal, axis=1)[:, None] * self.along.T
        across = self.across.T[:, :, None] * normal[:, None, :2]
        return np.hstack([by_ray, across.reshape(len(normal), -1)])


def error_shapes(away: Array, cosine: Array, half: Array, standoff: float | None = None) -> ErrorShapes:
    """Return how N points move per unit of each smooth error that a scanner may have.

    First come corrections along the ray, opposite to the error: COARSE Legendre products over the field, whose rms is 1
    together, and 1/cos − 1 of the angle of incidence. With a standoff come further errors, all about as large as one:
    along the ray finer Legendre products and powers of the range, across it slopes and squares over the field, and the
    range. A scanner with skew axes or a nonlinear scale is a combination of these.

    Args:
        away: (N, 3) from the scanner's eye to the points.
        cosine: (N,) of the angle of incidence.
        half: (2,) half width and height of the field, of `half_field`.
        standoff: median range, length_unit, from which the range is counted as a share; None: corrections alone.
    """
    length = np.linalg.norm(away, axis=1)
    products = legendre_products(away, half, _DEGREE if standoff is None else _FINE_DEGREE)
    along = [-shape for shape in (*products[:COARSE], 1 / cosine - 1)]
    across = list[Array]()
    if standoff is not None:
        distance = length / standoff - 1
        a, b = away[:, :2].T / away[:, 2] / half[:, None]
        along += [*products[COARSE:], distance, distance**2, distance**3, distance * a, distance * b]
        across = [a, b, a**2, a * b, b**2, distance]
    return ErrorShapes(away / length[:, None], np.array(along), np.array(across).reshape(-1, len(away)))


def legendre_products(away: Array, half: Array, degree: int = _FINE_DEGREE) -> list[Array]:
    """Return the Legendre products P_i(x/z) P_j(y/z) with 0 < i + j ≤ degree, each (N,), in the order of i + j.

    There are COARSE of degree 3, FINE of degree 6. Each is divided by i + j, since finer errors are smaller; all by one
    number that makes the rms of the first COARSE together 1.

    Args:
        away: (N, 3) rays from the scanner's eye.
        half: (2,) half width and height of the field, of `half_field`: there x/z and y/z count as 1.
    """
    a, b = np.clip(away[:, :2] / away[:, 2:] / half, -1.2, 1.2).T
    powers = [legendre.legvander(x, degree) * np.sqrt(2 * np.arange(degree + 1) + 1) for x in (a, b)]
    unit = np.sqrt(sum(1.0 / sum(order) ** 2 for order in _LEGENDRE_ORDERS[:COARSE]))
    return [powers[0][:, i] * powers[1][:, j] / ((i + j) * unit) for i, j in _LEGENDRE_ORDERS if i + j <= degree]


@dataclass(frozen=True)
class SmoothErrorLikelihood:
    """The likelihood of the sizes of smooth errors of C causes, from what they leave in overlaps beside free poses.

    Errors f of variances S change the normal equations by M f: Mf + noise is N(0, M S M + cσ²M). Every cause has a size
    of its own, a share of the scanner's noise.
    """

    data: Array  # (n,) right-hand side of the normal equations, along the eigenvectors of M that the overlaps show
    design: tuple[Array, ...]  # (n, K_c) per cause, change of `data` by its errors where they are as large as the noise
    scatter: Array  # (n,) variances of `data` without errors

    @property
    def map_shares(self) -> Array:
        """(C,) by cause the rms of the errors over the scanner's noise, at the maximum of the posterior (MAP).

        The prior is log-normal about `USUAL_SHARE` with spread `SHARE_SPREAD`.
        """

        def deviance(log_shares: Array) -> tuple[float, Array]:
            """Return −2 log posterior and its slopes (C,)."""
            prior = (log_shares - np.log(USUAL_SHARE)) / SHARE_SPREAD
            value, slope = self._deviance(log_shares)
            return value + float(prior @ prior), slope + 2 * prior / SHARE_SPREAD

        start = np.full(len(self.design), np.log(USUAL_SHARE))
        bounds = [tuple(np.log(SHARE_BOUNDS))] * len(start)
        return np.exp(minimize(deviance, start, jac=True, method="L-BFGS-B", bounds=bounds).x)

    def error_moments(self, cause: int, shares: Array) -> tuple[Array, Array, float]:
        """Return posterior mean (K_c,) and second moment E[ffᵀ] (K_c, K_c) of the errors f of one cause, and degrees of
        freedom: how well E[|f|²] is known. Errors are in units of the scanner's noise.

        How large the errors are nobody knows, so that their size s, one sigma, is integrated over its posterior p(s).
        Data d = T f + rest, the rest of covariance B. Given s, f is normal with covariance C = (A + 1/s²)⁻¹ and mean
        f̂ = C b, where A = TᵀB⁻¹T and b = TᵀB⁻¹d; p(s) ∝ |1 + s²A|^(−1/2) exp(½ bᵀf̂) π(s) (Box and Tiao 1973, 5.2).
        The prior π is log-normal about `USUAL_SHARE`. A variance has twice its square over its own variance as degrees
        of freedom (JCGM 100, G.4).

        Args:
            cause: number of the cause in `design`.
            shares: (C,) sizes of all causes over the noise; that of `cause` itself does not count.
        """
        T = self.design[cause]
        others = np.where(np.arange(len(shares)) == cause, 0.0, shares)
        solved = np.linalg.solve(self._data_covariance(others), T)
        # Along the eigenvectors of A the errors are independent of each other: what follows is one row a size s.
        A, axes = np.linalg.eigh(T.T @ solved)
        b = axes.T @ (solved.T @ self.data)
        square_sizes = USUAL_SHARE**2 * np.exp(2 * SHARE_SPREAD * _SIZE_SIGMAS)[:, None]
        growth = 1 + square_sizes * np.maximum(A, 0.0)
        variance = square_sizes / growth
        mean = variance * b
        log_posterior = -0.5 * (np.log(growth).sum(axis=1) - mean @ b + _SIZE_SIGMAS**2)
        weights = np.exp(log_posterior - log_posterior.max())
        weights /= weights.sum()
        moment = (mean.T * weights) @ mean + np.diag(weights @ variance)
        total = (mean**2 + variance).sum(axis=1)
        variance_of_total = max(float(weights @ (total - weights @ total) ** 2), 1e-300)
        degrees = float(2 * (weights @ total) ** 2 / variance_of_total)
        return axes @ (weights @ mean), axes @ moment @ axes.T, degrees

    def ml_shares(self, limits: Mapping[int, float] | None = None) -> tuple[Array, float]:
        """Return the shares (C,) of maximum likelihood, and −2 log likelihood there.

        Args:
            limits: by number of the cause, the largest share that it may have; others have `SHARE_BOUNDS`.
        """
        largest_shares = dict.fromkeys(range(len(self.design)), SHARE_BOUNDS[1]) | dict(limits or {})
        bounds = [(np.log(SHARE_BOUNDS[0]), np.log(size)) for size in largest_shares.values()]
        # The likelihood is flat where errors are small, so that one search begins at the largest sizes, one at usual
        # ones.
        largest = np.array([b for _, b in bounds])
        starts = [largest, np.minimum(largest, np.log(USUAL_SHARE))]
        fits = [minimize(self._deviance, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
        best = min(fits, key=lambda fit: float(fit.fun))
        return np.exp(best.x), float(best.fun)

    def estimate(self, cause: int, shares: Array) -> Array:
        """Return the likeliest errors (K_c,) of one cause in units of its size, where all causes have shares (C,)."""
        return shares[cause] * self.design[cause].T @ np.linalg.solve(self._data_covariance(shares), self.data)

    def posterior_covariance(self, cause: int, shares: Array) -> Array:
        """Return the posterior covariance (K_c, K_c) of the errors of one cause, in units of its size squared.

        It is the identity where the overlaps say nothing.

        Args:
            cause: number of the cause in `design`.
            shares: (C,) sizes of all causes over the noise.
        """
        columns = shares[cause] * self.design[cause]
        return np.eye(columns.shape[1]) - columns.T @ np.linalg.solve(self._data_covariance(shares), columns)

    def _data_covariance(self, shares: Array) -> Array:
        """Return the covariance (n, n) of `data` where all causes have shares (C,)."""
        parts = [share**2 * t @ t.T for share, t in zip(shares, self.design, strict=True)]
        return sum(parts, np.diag(self.scatter))

    def _deviance(self, log_shares: Array) -> tuple[float, Array]:
        """Return −2 log likelihood at logarithms of the shares (C,), and its slopes (C,) in these."""
        parts = [np.exp(2 * log_share) * t @ t.T for log_share, t in zip(log_shares, self.design, strict=True)]
        covariance = sum(parts, np.diag(self.scatter))
        inverse = np.linalg.inv(covariance)
        weighted = inverse @ self.data
        slopes = [2 * (np.sum(inverse * part) - weighted @ part @ weighted) for part in parts]
        return float(np.linalg.slogdet(covariance)[1] + self.data @ weighted), np.array(slopes)


def shared_error_likelihood(
    sums: PointGram, unconstrained: UnconstrainedPoses, noise: float, nuisance: int = 0, per_view: int = 0
) -> SmoothErrorLikelihood:
    """Return the likelihood of smooth errors that are the same in every view: causes are the field, and incidence.

    Args:
        sums: over pairs for shapes over the field, the one of incidence, then `nuisance` others.
        noise: of the scanner along the ray, length_unit.
        nuisance: number of the last parameters, which may have any size.
        per_view: number of the first parameters, which the sums hold twice: for the first view of a pair, then for the
            second.
    """
    g = unconstrained.overlaps.gram
    # What the sums hold for either view is one and the same parameter.
    parameter = np.append(np.arange(per_view), np.arange(sums.residual.shape[1] - per_view))
    M, vector = _equations(sums, g, np.broadcast_to(parameter, (len(g.pairs), len(parameter))))
    units = np.eye(len(M) - nuisance)
    return _likelihood_of(M, vector, (units[:, :-1], units[:, -1:]), g, noise, nuisance)


def view_error_likelihood(
    sums: PointGram, unconstrained: UnconstrainedPoses, noise: float, nuisance: int = 0
) -> SmoothErrorLikelihood:
    """Return the likelihood of smooth errors with the causes SHARED, INCIDENCE and PER_VIEW.

    Shared shapes are the same in all views. Those per view are the same in the views of one part of the session: up to
    `_MAX_PARTS` parts follow each other in time, of fewer views each is a part.

    Args:
        sums: of `sum_smooth_errors` with per_view=True.
        noise: of the scanner along the ray, length_unit.
        nuisance: number of the last parameters of the sums, which may have any size.
    """
    g = unconstrained.overlaps.gram
    part = part_of_view(g.views)
    parts = int(part[-1]) + 1
    # The parameters are COARSE shapes of each part, one over incidence, further shapes of all views, then the nuisance.
    of_parts = [COARSE * part[view][:, None] + np.arange(COARSE) for view in g.pairs.astype(np.int64).T]
    shared = COARSE * parts + np.arange(sums.residual.shape[1] - 2 * COARSE)
    parameter = np.hstack([*of_parts, np.broadcast_to(shared, (len(g.pairs), len(shared)))])
    M, vector = _equations(sums, g, parameter)
    K = len(M) - nuisance
    per_part, incidence, further = np.split(np.eye(K), [COARSE * parts, COARSE * parts + 1], axis=1)
    # A coarse shape that all views share is the same coefficient in every part.
    coarse = per_part @ np.tile(np.eye(COARSE), (parts, 1))
    causes = (np.hstack([coarse, further]), incidence, per_part)
    return _likelihood_of(M, vector, causes, g, noise, nuisance, threshold=_NORMAL_NOISE)


def part_of_view(views: int) -> Indices:
    """Return the part (V,) of the session to which a view belongs."""
    return np.arange(views) * min(views, _MAX_PARTS) // views


def _equations(sums: PointGram, g: Gram, parameter: Indices) -> tuple[Array, Array]:
    """Return the normal equations M f = vector, (K, K) and (K,), of smooth errors f.

    They are Σ w g gᵀ and Σ w g e over the pairs of views, less what motions of the views absorb.

    Args:
        parameter: (P, columns) the parameter that each column of the sums of a pair stands for.
    """
    count = int(parameter.max()) + 1
    M, vector = np.zeros((count, count)), np.zeros(count)
    np.add.at(M, (parameter[:, :, None], parameter[:, None, :]), sums.square)
    np.add.at(vector, parameter, sums.residual)
    by_surfaces, by_targets = sum_on_views(g, sums.vector, parameter)
    on_views = by_surfaces + by_targets
    M -= on_views.T @ solve_view_sums(g, by_surfaces, by_targets)
    # The iteration of the views ended a small step short of where they agree best.
    vector += on_views.T @ visible_step(g).ravel()
    return M, vector


def _likelihood_of(
    M: Array,
    vector: Array,
    causes: Sequence[Array],
    g: Gram,
    noise: float,
    nuisance: int,
    threshold: float = _ROUNDING_SHARE,
) -> SmoothErrorLikelihood:
    """Return the likelihood of sizes of errors f from the normal equations M f = vector, in the eigenvectors of M.

    There Mf + noise is N(0, M S M + cσ²M), with S the covariance of f by its causes, σ² the variance between surfaces
    and c = `_CORRELATION_FACTOR`.

    Args:
        M: (K, K) Σ w g gᵀ less the part that motions of the views absorb.
        vector: (K,) Σ w g e, less the same.
        causes: (K − nuisance, K_c) per cause, the parameters per unit of each of its errors.
        noise: of the scanner along the ray, length_unit: a share of 1 is an error of this size.
        nuisance: number of the last parameters, which may have any size and are eliminated.
        threshold: eigenvalues below this share of the largest count as not seen.
    """
    M = (M + M.T) / 2
    if nuisance:
        # The Schur complement: what the nuisance parameters cannot explain.
        K = len(M) - nuisance
        explained = M[:K, K:] @ np.linalg.pinv(M[K:, K:], rcond=_ROUNDING_SHARE, hermitian=True)
        M, vector = M[:K, :K] - explained @ M[K:, :K], vector[:K] - explained @ vector[K:]
    values, vectors = np.linalg.eigh(M)
    keep = values > threshold * values[-1]
    values, vectors = values[keep], vectors[:, keep]
    per_parameter = noise * values[:, None] * vectors.T
    scatter = _CORRELATION_FACTOR * g.variance * values
    return SmoothErrorLikelihood(vectors.T @ vector, tuple(per_parameter @ cause for cause in causes), scatter)
