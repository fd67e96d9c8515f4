"""Smooth errors of a scanner, over its field and over incidence, and what they do to the overlaps."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from scipy.optimize import minimize

from stitch.model.forward import PointSlopes
from stitch.model.model import Model, Term
from stitch.numerics.distributions import chi2_tail, tukey
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import project_out
from stitch.observations.surfaces.effect_columns import PointGram, apparent_twists, stream_point_sums
from stitch.observations.surfaces.hand_eye_fit import SCANNER_FIELD, SCANNER_SCALE
from stitch.observations.surfaces.normal_equations import Gram, Overlaps
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, solve_view_sums, visible_step
from stitch.session.measurement import Measurement

# Along the ray; finer ones only where views may have errors for themselves, which are not to explain what all share.
_DEGREE, _FINE_DEGREE = 3, 6
# Corners are seen by few points.
_FIELD_QUANTILE = 0.98
_LEGENDRE_ORDERS = sorted(
    ((i, j) for i in range(_FINE_DEGREE + 1) for j in range(_FINE_DEGREE + 1) if 0 < i + j <= _FINE_DEGREE), key=sum
)
# Along the ray over the field, coarse ones first; the slope with incidence follows them.
COARSE = sum(sum(order) <= _DEGREE for order in _LEGENDRE_ORDERS)
# With the finer ones, which come first of what all views may have in common besides.
FINE = len(_LEGENDRE_ORDERS)


def sum_smooth_errors(
    measurement: Measurement,
    unconstrained: UnconstrainedPoses,
    point_effects: PointSlopes | None = None,
    per_view: bool = False,
) -> tuple[PointGram, float]:
    """Sums of smooth errors of unit size, then of what is beside them, and the noise; NaN without scans.

    The first are COARSE, along the ray over the field, and one over incidence.

    Args:
        per_view: those of COARSE for either view of a pair its own; and after the one over incidence what all views may
            have in common besides.
    """
    capture, half = measurement.capture, half_field(measurement)
    further = point_effects or PointSlopes(measurement, ())
    standoff = float(np.median(np.concatenate([np.linalg.norm(s.points - s.eye, axis=1) for s in capture.scans])))

    def corrections(away: Array, cosine: Array) -> Array:
        own = smooth_corrections(away, cosine, half)
        return np.concatenate([own, _shared_shapes(away, half, standoff)]) if per_view else own

    def of_points(v: int, index: Indices) -> Array:
        scan = capture.scans[v]
        smooth = corrections(scan.points.take(index, axis=0) - scan.eye, measurement.scan_views[v].cosine[index])
        return np.concatenate([smooth, further.at(v, unconstrained.poses[v], index)])

    def of_targets() -> Array:
        assert capture.sightings is not None
        points = capture.sightings.points
        seen = capture.sightings.target >= 0
        # An empty slot has no ray; nobody knows at what slant a target was seen.
        flat = np.where(seen[..., None], points, [0.0, 0.0, 1.0]).reshape(-1, 3)
        moved = corrections(flat, np.ones(len(flat))).reshape(-1, *points.shape)
        smooth = np.where(seen[..., None], moved, 0.0)
        return np.concatenate([smooth, further.at_targets(unconstrained.poses)])

    sums = stream_point_sums(unconstrained, capture.noise_factor, of_points, of_targets, COARSE if per_view else 0)
    return sums, float(np.nanmedian([scan.noise for scan in capture.scans]))


def half_field(measurement: Measurement) -> Array:
    """(2,) |x/z| and |y/z| in the scanner's frame up to which it sees, but for the corners."""
    away = np.concatenate([scan.points - scan.eye for scan in measurement.capture.scans])
    slopes = np.abs(away[:, :2] / away[:, 2:])
    return np.maximum(np.quantile(slopes, _FIELD_QUANTILE, axis=0), 1e-6)


def smooth_corrections(away: Array, cosine: Array, half: Array) -> Array:
    """(COARSE + 1, N, 3) what undoes smooth errors along the rays (N, 3) from the scanner's eye, per unit.

    Legendre products over the field, of unit rms together, and the slope with incidence.
    """
    along = [*legendre_products(away, half, _DEGREE), 1 / cosine - 1]
    return -np.array(along)[..., None] * _unit_vectors(away)


def _shared_shapes(away: Array, half: Array, standoff: float) -> Array:
    """(S, N, 3) what all views may have in common besides: finer over the field, along the range, and across the ray.

    Each is about as large as the others; scanners of bad axes or a bent scale are among them.
    """
    ray = _unit_vectors(away)
    far = np.linalg.norm(away, axis=1) / standoff - 1
    a, b = away[:, :2].T / away[:, 2] / half[:, None]
    along = [*legendre_products(away, half)[COARSE:], far, far**2, far**3, far * a, far * b]
    across = [shape[:, None] * axis for shape in (a, b, a**2, a * b, b**2, far) for axis in np.eye(3)[:2]]
    return np.concatenate([np.array(along)[..., None] * ray, np.array(across)])


def legendre_products(away: Array, half: Array, degree: int = _FINE_DEGREE) -> list[Array]:
    """FINE Legendre products (N,) over the field for rays (N, 3); the first COARSE have unit rms together.

    Args:
        half: (2,) of `half_field`, where the products end.
    """
    a, b = np.clip(away[:, :2] / away[:, 2:] / half, -1.2, 1.2).T
    powers = [legendre.legvander(x, degree) * np.sqrt(2 * np.arange(degree + 1) + 1) for x in (a, b)]
    unit = np.sqrt(sum(1.0 / sum(order) ** 2 for order in _LEGENDRE_ORDERS[:COARSE]))
    return [powers[0][:, i] * powers[1][:, j] / ((i + j) * unit) for i, j in _LEGENDRE_ORDERS if i + j <= degree]


def _unit_vectors(away: Array) -> Array:
    return away / np.linalg.norm(away, axis=1)[:, None]


# How large smooth errors are that the overlaps show: variance components by likelihood, one for each cause.

# What every scanner has, as a share of its noise along the ray, and the spread of its logarithm; what is asked at all.
USUAL_SHARE, _SHARE_SPREAD, SHARE_BOUNDS = 0.3, 0.7, (0.01, 10.0)
# Neighbouring distances share points and normals: so many times the variance of independent ones.
_CORRELATION_FACTOR = 3.0
# Combinations that the overlaps show less than this share of the clearest are rounding.
_ROUNDING_SHARE = 1e-6


@dataclass(frozen=True)
class SmoothErrorLikelihood:
    """What smooth errors of C causes leave within the overlaps, beside free poses, and how likely each size is.

    Errors f of variances S change the normal equations there by M f: Mf + noise is N(0, M S M + cσ²M). The causes
    need not be equally large.
    """

    data: Array  # (n,) in the directions that the overlaps show
    design: tuple[Array, ...]  # (n, K_c) per cause, for errors as large as the noise
    scatter: Array  # (n,) variances of `seen` without errors

    @classmethod
    def from_normal_equations(
        cls,
        M: Array,
        vector: Array,
        causes: Sequence[Array],
        g: Gram,
        noise: float,
        nuisance: int = 0,
        threshold: float = _ROUNDING_SHARE,
    ) -> "SmoothErrorLikelihood":
        """Of normal equations (K, K) and (K,), less what moving the views takes away.

        Args:
            causes: (K − beside, K_c) the errors of each cause, of unit size, in those parameters.
            nuisance: so many of the last parameters may have any size.
            threshold: combinations that the overlaps show less than this share of the clearest count as not seen.
        """
        M = (M + M.T) / 2
        if nuisance:
            # The Schur complement: what no size of those explains.
            K = len(M) - nuisance
            taken = M[:K, K:] @ np.linalg.pinv(M[K:, K:], rcond=_ROUNDING_SHARE, hermitian=True)
            M, vector = M[:K, :K] - taken @ M[K:, :K], vector[:K] - taken @ vector[K:]
        values, vectors = np.linalg.eigh(M)
        keep = values > threshold * values[-1]
        values, vectors = values[keep], vectors[:, keep]
        moved = noise * values[:, None] * vectors.T
        return cls(
            vectors.T @ vector, tuple(moved @ cause for cause in causes), _CORRELATION_FACTOR * g.variance * values
        )

    @property
    def map_shares(self) -> Array:
        """(C,) likeliest rms of the errors over the noise, with a prior of usual sizes."""

        def deviance(log_shares: Array) -> tuple[float, Array]:
            prior = (log_shares - np.log(USUAL_SHARE)) / _SHARE_SPREAD
            value, slope = self._deviance(log_shares)
            return value + float(prior @ prior), slope + 2 * prior / _SHARE_SPREAD

        start = np.full(len(self.design), np.log(USUAL_SHARE))
        bounds = [tuple(np.log(SHARE_BOUNDS))] * len(start)
        return np.exp(minimize(deviance, start, jac=True, method="L-BFGS-B", bounds=bounds).x)

    def share_spread(self, shares: Array) -> Array:
        """(C,) standard deviations of the logarithms of `map_shares`, from the curvature of their posterior there."""
        logs, step = np.log(shares), 1e-3 * np.eye(len(shares))
        slopes = [self._deviance(logs + s)[1] - self._deviance(logs - s)[1] for s in step]
        curvature = np.array(slopes) / 4e-3 + np.eye(len(shares)) / _SHARE_SPREAD**2
        # Where the likelihood bends the other way the prior alone counts.
        values, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
        return np.sqrt((vectors**2) @ (1 / np.maximum(values, _SHARE_SPREAD**-2.0)))

    def ml_shares(self, most: Sequence[float]) -> tuple[Array, float]:
        """Shares (C,) without a prior, at most so large, and −2 log likelihood."""
        bounds = [(np.log(SHARE_BOUNDS[0]), np.log(size)) for size in most]
        # The likelihood is flat where errors are small: from the largest on, and from usual ones.
        largest = np.array([b for _, b in bounds])
        starts = [largest, np.minimum(largest, np.log(USUAL_SHARE))]
        fits = [minimize(self._deviance, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
        best = min(fits, key=lambda fit: float(fit.fun))
        return np.exp(best.x), float(best.fun)

    def estimate(self, cause: int, shares: Array) -> Array:
        """(K_c,) the likeliest errors of one cause in units of its size, where all causes have shares (C,)."""
        return shares[cause] * self.design[cause].T @ np.linalg.solve(self._data_covariance(shares), self.data)

    def posterior_covariance(self, cause: int, shares: Array) -> Array:
        """(K_c, K_c) covariance of the errors of one cause about their estimate, in units of its size: one where the
        overlaps tell nothing of them.
        """
        told = shares[cause] * self.design[cause]
        return np.eye(told.shape[1]) - told.T @ np.linalg.solve(self._data_covariance(shares), told)

    def _data_covariance(self, shares: Array) -> Array:
        """(n, n) variance of `seen` where all causes have shares (C,)."""
        parts = [share**2 * t @ t.T for share, t in zip(shares, self.design, strict=True)]
        return sum(parts, np.diag(self.scatter))

    def _deviance(self, log_shares: Array) -> tuple[float, Array]:
        """−2 log likelihood and its slopes (C,)."""
        parts = [np.exp(2 * log_share) * t @ t.T for log_share, t in zip(log_shares, self.design, strict=True)]
        spread = sum(parts, np.diag(self.scatter))
        inverse = np.linalg.inv(spread)
        weighed = inverse @ self.data
        slopes = [2 * (np.sum(inverse * part) - weighed @ part @ weighed) for part in parts]
        return float(np.linalg.slogdet(spread)[1] + self.data @ weighed), np.array(slopes)


# Smooth errors that every view has for itself: what the overlaps show of them, beside those that all views share.
#
# A part that bends, a scanner that warms up or is read line by line while the arm still moves: each scan is sound, and
# no motion of the views makes them meet.

# Normals are off by up to a tenth of a radian: what moves points less than that along them, squared, is their noise.
_NORMAL_NOISE = 0.01
# Of many views those that follow each other have errors in common: so many parts of a session at most.
_MAX_PARTS = 30

# The causes of `by_view`: over the field the same in every view, over incidence, over the field view by view.
SHARED, INCIDENCE, PER_VIEW = range(3)


def view_error_likelihood(
    sums: PointGram, unconstrained: UnconstrainedPoses, noise: float, nuisance: int = 0
) -> SmoothErrorLikelihood:
    """Of sums over smooth errors for either view of a pair its own, those that all share, and what is beside them.

    Args:
        sums: of `sum_smooth_errors` with errors of every view.
    """
    g, part = unconstrained.overlaps.gram, part_of_view(unconstrained.overlaps.gram.views)
    at = _column_parameters(g.pairs, part, columns=sums.residual.shape[1])
    width = int(at.max()) + 1
    square, pull = np.zeros((width, width)), np.zeros(width)
    np.add.at(square, (at[:, :, None], at[:, None, :]), sums.square)
    np.add.at(pull, at, sums.residual)
    push = [_sum_on_views(sums, g.views, g.pairs, at, keep, width) for keep in (~g.labelled, g.labelled)]
    both = push[0] + push[1]
    square -= both.T @ solve_view_sums(g, *push)
    # The iteration ended a small step short of where the views agree best.
    pull += both.T @ visible_step(g).ravel()
    causes = _cause_columns(int(part[-1]) + 1, width - nuisance)
    return SmoothErrorLikelihood.from_normal_equations(
        square, pull, causes, g, noise, nuisance, threshold=_NORMAL_NOISE
    )


def part_of_view(views: int) -> Indices:
    """(V,) the part of the session to which a view belongs."""
    return np.arange(views) * min(views, _MAX_PARTS) // views


def _column_parameters(pairs: Array, part: Indices, columns: int) -> Indices:
    """(P, columns) the parameter that each column of a pair is: those of every part, then those that all share."""
    own = [COARSE * part[view][:, None] + np.arange(COARSE) for view in pairs.astype(np.int64).T]
    shared = COARSE * (part[-1] + 1) + np.arange(columns - 2 * COARSE)
    return np.hstack([*own, np.broadcast_to(shared, (len(pairs), len(shared)))])


def _sum_on_views(sums: PointGram, views: int, pairs: Array, at: Indices, keep: Mask, width: int) -> Array:
    """(6V, W) Σ w Bᵀg of some pairs on their views."""
    out = np.zeros((views, width, 6))
    v, w = pairs[keep].astype(np.int64).T
    vectors = np.moveaxis(sums.vector[keep], 1, 2)
    np.add.at(out, (v[:, None], at[keep]), vectors)
    np.subtract.at(out, (w[:, None], at[keep]), vectors)
    return np.moveaxis(out, 1, 2).reshape(6 * views, width)


def _cause_columns(parts: int, width: int) -> tuple[Array, Array, Array]:
    """SAME, INCIDENCE and CHANGING in the parameters, (width, ·) each."""
    every = np.eye(width)
    own, incidence, shared = np.split(every, [COARSE * parts, COARSE * parts + 1], axis=1)
    return np.hstack([own @ np.tile(np.eye(COARSE), (parts, 1)), shared]), incidence, own


# What every scanner has: a smooth error over its field and over incidence, a fraction of its noise, in all views.
#
# It repeats from view to view, so no number of views averages it out, and it pretends to be a small effect of the
# scanner. Diagnosis counts it as known scatter: what an effect must exceed. Hand-eye and effects are no better known
# than it lets them.

# Rms over the field, as a share of the scanner's noise along the ray: what an effect must exceed to be named. An
# effect of the scanner that is missing looks like a larger one, so this is not taken from the scans.
ALARM_SHARE = 0.5


def field_scatter(
    measurement: Measurement, unconstrained: UnconstrainedPoses, share: float | None = ALARM_SHARE
) -> Array:
    """(6V, K) twists that the views show for one standard deviation of each of K independent smooth errors.

    Args:
        share: rms of the errors over the scanner's noise; None takes it from what the overlaps show.
    """
    sums, noise = sum_smooth_errors(measurement, unconstrained)
    twists = apparent_twists(sums, unconstrained)
    if not np.isfinite(noise):
        return np.zeros_like(twists)
    if share is not None:
        return twists * noise * share
    field, incidence = shared_error_likelihood(sums, twists, unconstrained, noise).map_shares
    return twists * noise * np.append(np.full(twists.shape[1] - 1, field), incidence)


def shared_error_likelihood(
    sums: PointGram, twists: Array, unconstrained: UnconstrainedPoses, noise: float, nuisance: int = 0
) -> SmoothErrorLikelihood:
    """What the overlaps show of errors that are the same in every view: over the field, and over incidence.

    Args:
        sums: of those, and of so many parameters beside them that may have any size.
        twists: (6V, K) of the views by all of them.
    """
    g = unconstrained.overlaps.gram
    own = twists.reshape(g.views, 6, -1)
    # What the poses do not follow: Σ g² less what moving the views takes away; the small step too by which the
    # iteration ended short of where the views agree best.
    v, w = g.pairs.T
    followed, step = np.einsum("pik,pil->kl", sums.vector, own[v] - own[w]), visible_step(g)
    pull = sums.residual.sum(axis=0) + np.einsum("pik,pi->k", sums.vector, step[v] - step[w])
    units = np.eye(twists.shape[1] - nuisance)
    causes = (units[:, :-1], units[:, -1:])
    return SmoothErrorLikelihood.from_normal_equations(
        sums.square.sum(axis=0) - followed, pull, causes, g, noise, nuisance
    )


def rig_field_scatters(measurements: Sequence[Measurement], unconstrained: Sequence[UnconstrainedPoses]) -> list[Array]:
    """The same for every session of a rig, as large as each shows it."""
    return [field_scatter(measurement, f, None) for measurement, f in zip(measurements, unconstrained, strict=True)]


# One standard deviation of a scanner's scale. Data sheets state length errors of 0.05 to 0.1 mm over half a metre
# (sphere spacing, VDI/VDE 2634) at the temperature of calibration; a few degrees more make as much.
SCALE_SIGMA = 2e-4


def rig_scanner_errors(
    measurements: Sequence[Measurement], unconstrained: Sequence[UnconstrainedPoses]
) -> dict[str, list[Array]]:
    """By source, per session of a rig twists (6V, K) of the views by one standard deviation of errors that all views
    of all sessions have in common."""
    return {
        SCANNER_FIELD: rig_field_scatters(measurements, unconstrained),
        SCANNER_SCALE: [scale_scatter(m, f) for m, f in zip(measurements, unconstrained, strict=True)],
    }


def scale_scatter(measurement: Measurement, unconstrained: UnconstrainedPoses) -> Array:
    """(6V, 1) twists that the views show for one standard deviation of the scanner's scale; none of a tracker.

    Scans that are all too large by the same share still fit each other, each moved along the way from the part to its
    scanner: so no overlap shows the scale, but the ways of the arm do. An arm whose lengths are all too short looks so.
    """
    if not measurement.has_optics:
        return np.zeros((6 * len(unconstrained.poses), 1))
    away = unconstrained.poses[:, :3, 3] - unconstrained.overlaps.gram.centre
    return SCALE_SIGMA * np.hstack([np.zeros_like(away), away]).reshape(-1, 1)


# A map of the smooth error that a scanner makes in every view alike: what the overlaps tell of it, place by place.
#
# Overlaps show differences between views alone. On a part that is nearly flat, moving the views does what a constant or
# a slope over the field does, and what a bowl does: seen from two places, its two images differ by a slope, however the
# scanner is rolled. The map has none of them. Errors across the ray, or along the range, are no map over the field:
# where they are most of what is shown, there is none.

# Places along either way across the field.
_GRID_PLACES = 25
# A place is drawn where the scans have at least this share of the points that it would have if all were spread evenly.
_MIN_POINT_DENSITY = 0.05
# Of what smooth errors leave in the overlaps, squared: the share that those along the ray over the field have to
# explain. Axes askew or of another scale leave less than 0.2 to them, laws along the ray more than 0.8.
_MIN_FIELD_SHARE = 0.7
# Maps of simulated scanners were off by 1.2 to 2.2 times what chance alone makes of them: normals are measured too, and
# a scanner's law is no polynomial.
_SIGMA_FACTOR = 2.0


@dataclass(frozen=True)
class FieldMap:
    """Error along the ray over the scanner's field, length_unit; positive where points are seen too far away."""

    x: Array  # (X,) x/|z| in the scanner's frame
    y: Array  # (Y,) y/|z|
    error: Array  # (Y, X) NaN where too few points were seen
    sigma: Array  # (Y, X) its standard uncertainty

    @property
    def rms(self) -> float:
        """Of the error, over what was seen of the field."""
        return float(np.sqrt(np.nanmean(self.error**2)))

    @property
    def uncertainty(self) -> float:
        """Rms of the standard uncertainty over the same."""
        return float(np.sqrt(np.nanmean(self.sigma**2)))


def field_map(
    measurement: Measurement, sums: PointGram, unconstrained: UnconstrainedPoses, noise: float, nuisance: int = 0
) -> FieldMap | None:
    """The likeliest error, as far as the overlaps tell it; None where it is not most of what they show.

    Args:
        sums: of `sum_smooth_errors` with errors of every view.
        noise: of the scanner, length_unit.
        nuisance: so many of the last parameters may have any size.
    """
    shown, sizes = _merge_coarse_fine(_coarse_fine_likelihood(sums, unconstrained, noise, nuisance))
    values = shown.estimate(0, np.ones(2))
    if _field_share(shown, values) < _MIN_FIELD_SHARE:
        return None
    half, forward = half_field(measurement), _viewing_sign(measurement)
    x, y = (np.linspace(-h, h, _GRID_PLACES) for h in half)
    seen = _observed_places(measurement, x, y, forward)
    a, b = (way[seen] for way in np.meshgrid(x, y))
    rays = np.stack([a, b, np.ones_like(a)], axis=1)
    # Coarse ones stand for what undoes the error, finer ones for the error itself.
    size = (
        np.where(np.arange(FINE) < COARSE, -1.0, 1.0) * sizes[:FINE] * noise / robust_pass_share(unconstrained.overlaps)
    )
    shapes = np.array(legendre_products(rays * [forward, forward, 1.0], half)).T * size
    shapes = project_out(np.column_stack([rays, a**2 + b**2]), shapes)
    error, sigma = (np.full(seen.shape, np.nan) for _ in range(2))
    error[seen] = shapes @ values[:FINE]
    sigma[seen] = _SIGMA_FACTOR * np.sqrt(
        np.sum((shapes @ shown.posterior_covariance(0, np.ones(2))[:FINE, :FINE]) * shapes, axis=1)
    )
    return FieldMap(x, y, error, sigma)


def _field_share(likelihood: SmoothErrorLikelihood, values: Array) -> float:
    """How much of what the errors (K,) leave in the overlaps, squared, those along the ray over the field explain."""
    whole = likelihood.design[0] @ values
    rest = whole - likelihood.design[0][:, :FINE] @ values[:FINE]
    squares = [float(np.sum(left**2 / likelihood.scatter)) for left in (rest, whole)]
    return 1 - squares[0] / squares[1] if squares[1] > 0 else 0.0


def robust_pass_share(overlaps: Overlaps) -> float:
    """How much of a small error robust weights let through, as a share of what fixed weights would.

    They fall as the error grows: Σ dψ/de over Σ ψ/e of Tukey's ψ (Huber & Ronchetti 2009, 7.6), 0.83 for normal noise.
    """
    root = np.sqrt(np.concatenate([tukey(m.residual, overlaps.gram.scale) for m in overlaps.matches]))
    weight = np.concatenate([m.weight for m in overlaps.matches])
    # With u = e/(c·sigma): the root is 1 − u², and dψ/de = (1 − u²)(1 − 5u²).
    return float(np.sum(weight * root * (5 * root - 4)) / np.sum(weight * root**2))


def _coarse_fine_likelihood(
    sums: PointGram, unconstrained: UnconstrainedPoses, noise: float, nuisance: int
) -> SmoothErrorLikelihood:
    """What the overlaps show of errors that all views share: coarse over the field, finer, and over incidence."""
    together = sums.merge_sides(per_view=COARSE)
    column = np.arange(together.residual.shape[1])
    # The one over incidence stands after the coarse ones; it is to come last.
    order: Any = np.concatenate(
        [np.delete(column[: len(column) - nuisance], COARSE), [COARSE], column[len(column) - nuisance :]]
    )
    shared = together.select(order)
    shown = shared_error_likelihood(shared, apparent_twists(shared, unconstrained), unconstrained, noise, nuisance)
    field, incidence = shown.design
    return replace(shown, design=(field[:, :COARSE], field[:, COARSE:], incidence))


def _merge_coarse_fine(likelihood: SmoothErrorLikelihood) -> tuple[SmoothErrorLikelihood, Array]:
    """Coarse and finer errors as one cause of unit size beside incidence, and the sizes (K,) that they have."""
    shares = likelihood.ml_shares([SHARE_BOUNDS[1]] * len(likelihood.design))[0]
    coarse, fine, incidence = (share * told for share, told in zip(shares, likelihood.design, strict=True))
    sizes = np.repeat(shares[:2], [coarse.shape[1], fine.shape[1]])
    return replace(likelihood, design=(np.hstack([coarse, fine]), incidence)), sizes


def _viewing_sign(measurement: Measurement) -> float:
    """1 where the scanner looks along its z, −1 where against it."""
    return float(np.sign(np.median([np.median(scan.points[:, 2] - scan.eye[2]) for scan in measurement.capture.scans])))


def _observed_places(measurement: Measurement, x: Array, y: Array, forward: float) -> Mask:
    """(Y, X) True at places about which the scans have points."""
    edges = [np.append(at, at[-1] + at[1] - at[0]) - (at[1] - at[0]) / 2 for at in (y, x)]
    counts = np.zeros((len(y), len(x)))
    for scan in measurement.capture.scans:
        away = scan.points - scan.eye
        slopes = forward * away[:, :2] / away[:, 2:]
        counts += np.histogram2d(slopes[:, 1], slopes[:, 0], bins=edges)[0]
    return counts > _MIN_POINT_DENSITY * counts.mean()


# Smooth errors larger than every scanner has, as the overlaps show them: the same in every view, or not.

_PERMUTATIONS = 999


@dataclass(frozen=True)
class FieldError:
    """Errors along the ray that are smooth over the scanner's field; rms in length_unit, 0 where not unusual."""

    rms: float  # of what is the same in every view
    rms_by_view: float  # of what every view has for itself
    gain: float  # nats by which the clearer of both is likelier than the largest that every scanner has
    over_noise: bool  # one of the two is more systematic than random
    by_view: bool = False  # the second is the clearer
    with_time: bool = False  # it follows the session
    map: FieldMap | None = field(default=None, compare=False, repr=False)  # where the first is the clearer

    @property
    def unusual(self) -> bool:
        """Larger than every scanner's."""
        return self.rms > 0 or self.rms_by_view > 0


def field_error(
    measurement: Measurement,
    model: Model,
    unconstrained: UnconstrainedPoses,
    alpha: float,
    nuisance_effects: Sequence[Term] = (),
) -> FieldError:
    """What the overlaps show of it; what it exceeds at the level `alpha`.

    Args:
        nuisance_effects: effects of points that may have any size there.
    """
    sums, noise = sum_smooth_errors(
        measurement, unconstrained, PointSlopes(measurement, nuisance_effects, model), per_view=True
    )
    if not np.isfinite(noise):
        return FieldError(0.0, 0.0, 0.0, over_noise=False)
    further = sum(len(term.parameters) for term in nuisance_effects)
    apart = view_error_likelihood(sums, unconstrained, noise, further)
    # Two questions, each at half of the level.
    changing = _cause_size(apart, PER_VIEW, alpha / 2)
    # What all views have in common comes first: large errors of that kind move points to other partners, which looks
    # like errors of single views.
    alone = changing.share > 0 and changing.gain > _shared_error_gain(apart)
    same = _cause_size(apart if alone else _coarse_likelihood(sums, unconstrained, noise, further), SHARED, alpha / 2)
    own = alone or (changing.share > 0 and not same.share)
    return FieldError(
        noise * same.share,
        noise * changing.share,
        max(same.gain, changing.gain),
        same.over_noise or changing.over_noise,
        own,
        changing.share > 0 and _follows_time(apart.estimate(PER_VIEW, changing.shares), alpha),
        field_map(measurement, sums, unconstrained, noise, further) if same.share and not own else None,
    )


@dataclass(frozen=True)
class _CauseSize:
    """Of errors of one cause, in units of the noise."""

    share: float  # 0 where not unusual
    shares: Array  # (C,) the likeliest of all causes
    gain: float
    over_noise: bool


def _cause_size(likelihood: SmoothErrorLikelihood, cause: int, alpha: float) -> _CauseSize:
    """The likeliest size of errors of one cause beside the others, if it is unusual."""

    def clear(gain: float) -> bool:
        # On the boundary of what is allowed: half of the χ² of one degree of freedom (Self & Liang 1987).
        return 0.5 * chi2_tail(2 * gain, 1) < alpha

    shares, free = likelihood.ml_shares(_share_limits(likelihood, {}))

    def nats(share: float) -> float:
        return 0.5 * (likelihood.ml_shares(_share_limits(likelihood, {cause: share}))[1] - free)

    gain = nats(ALARM_SHARE)
    if not clear(gain):
        return _CauseSize(0.0, shares, gain, over_noise=False)
    return _CauseSize(float(shares[cause]), shares, gain, clear(nats(1.0)))


def _shared_error_gain(likelihood: SmoothErrorLikelihood) -> float:
    """Nats that errors of all views gain over usual ones where those of single views are usual."""
    usual = {PER_VIEW: ALARM_SHARE}
    deviances = [
        likelihood.ml_shares(_share_limits(likelihood, limits))[1] for limits in (usual | {SHARED: ALARM_SHARE}, usual)
    ]
    return 0.5 * (deviances[0] - deviances[1])


def _share_limits(likelihood: SmoothErrorLikelihood, limits: dict[int, float]) -> list[float]:
    """The largest share of each cause."""
    return [limits.get(cause, SHARE_BOUNDS[1]) for cause in range(len(likelihood.design))]


def _coarse_likelihood(
    sums: PointGram, unconstrained: UnconstrainedPoses, noise: float, nuisance: int
) -> SmoothErrorLikelihood:
    """The same in every view, without the finer ones: what is known of it where no view has errors for itself."""
    together = sums.merge_sides(per_view=COARSE)
    column = np.arange(together.residual.shape[1])
    coarse = together.select((column <= COARSE) | (column >= len(column) - nuisance))
    return shared_error_likelihood(coarse, apparent_twists(coarse, unconstrained), unconstrained, noise, nuisance)


def _follows_time(errors: Array, alpha: float) -> bool:
    """True where errors of the views, part after part, follow their order more than other orders would have it."""
    parts = len(errors) // COARSE
    errors = errors.reshape(parts, -1)
    order = np.arange(parts) - (parts - 1) / 2
    generator = np.random.default_rng(parts)
    others = np.array([generator.permutation(order) for _ in range(_PERMUTATIONS)])
    trend = np.linalg.norm(order @ errors)
    return bool((1 + np.sum(np.linalg.norm(others @ errors, axis=1) >= trend)) / (1 + _PERMUTATIONS) < alpha)
