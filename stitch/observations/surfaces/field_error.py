"""Smooth errors of a scanner larger than every scanner has, as the overlaps show them, and a map of them.

The same in every view, or not: two questions, each held against what every scanner has (`scanner_errors.py`).

Overlaps show differences between views alone. On a part that is nearly flat, moving the views does what a constant or
a slope over the field does, and what a bowl does: seen from two places, its two images differ by a slope, however the
scanner is rolled. The map has none of them. Errors across the ray, or along the range, are no map over the field:
where they are most of what is shown, there is none.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stitch.model.forward import PointSlopes
from stitch.model.model import Model, Term
from stitch.numerics.distributions import chi2_limit, tukey
from stitch.numerics.frames import Array, Mask
from stitch.numerics.least_squares import project_out
from stitch.observations.surfaces.effect_columns import PointGram
from stitch.observations.surfaces.normal_equations import Overlaps
from stitch.observations.surfaces.scanner_errors import (
    ALARM_SHARE,
    COARSE,
    FINE,
    PER_VIEW,
    SHARED,
    SmoothErrorLikelihood,
    half_field,
    legendre_products,
    shared_error_likelihood,
    sum_smooth_errors,
    view_error_likelihood,
)
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.session.measurement import Measurement

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
_PERMUTATIONS = 999


@dataclass(frozen=True)
class FieldMap:
    """Error along the ray over the scanner's field, length_unit; positive where points are seen too far away."""

    x: Array  # (X,) x/|z| in the scanner's frame
    y: Array  # (Y,) y/|z|
    error: Array  # (Y, X) NaN where too few points were seen
    sigma: Array  # (Y, X) its standard uncertainty

    @property
    def rms(self) -> float:
        """Root mean square of the error over the places that were seen, length_unit."""
        return float(np.sqrt(np.nanmean(self.error**2)))

    @property
    def uncertainty(self) -> float:
        """Root mean square of the standard uncertainty over these places, length_unit."""
        return float(np.sqrt(np.nanmean(self.sigma**2)))


@dataclass(frozen=True)
class FieldError:
    """Errors along the ray that are smooth over the scanner's field; rms in length_unit, 0 where not unusual."""

    rms: float  # of errors that are the same in every view
    rms_by_view: float  # of errors that every view has for itself
    gain: float  # log likelihood ratio, nats, of the clearer of both against the largest size that every scanner has
    over_noise: bool  # one of the two is larger than the scanner's noise
    by_view: bool = False  # those by view are the clearer, or the only ones
    with_time: bool = False  # those by view have a trend over the session
    map: FieldMap | None = field(default=None, compare=False, repr=False)  # where those of all views are the clearer

    @property
    def unusual(self) -> bool:
        """True if one of the two errors is larger than every scanner has."""
        return self.rms > 0 or self.rms_by_view > 0


def field_error(
    measurement: Measurement,
    model: Model,
    unconstrained: UnconstrainedPoses,
    alpha: float,
    nuisance_effects: Sequence[Term] = (),
) -> FieldError:
    """Return the smooth errors of the scanner that the overlaps show: those that all views share, and those by view.

    Each is tested against `ALARM_SHARE`, the size that every scanner has, at half of the level. Errors of single views
    are tested while shared ones may have any size. Shared errors are tested so too where those of single views are
    clearer, else in a likelihood without errors of single views.

    Args:
        model: under which the effects are linearised.
        alpha: level of the tests: probability of a false alarm.
        nuisance_effects: effects that move points, with parameters of any size; what they can explain is no error here.
    """
    sums, noise = sum_smooth_errors(
        measurement, unconstrained, PointSlopes(measurement, nuisance_effects, model), per_view=True
    )
    if not np.isfinite(noise):
        return FieldError(0.0, 0.0, 0.0, over_noise=False)
    nuisance = sum(len(term.parameters) for term in nuisance_effects)
    by_causes = view_error_likelihood(sums, unconstrained, noise, nuisance)
    # Two questions, each at half of the level.
    per_view = _cause_size(by_causes, PER_VIEW, alpha / 2)
    # Shared errors come first unless the others are clearer: large shared errors move points to other partners, which
    # looks like errors of single views.
    per_view_is_clearer = per_view.share > 0 and per_view.gain > _shared_error_gain(by_causes)
    if per_view_is_clearer:
        shared = _cause_size(by_causes, SHARED, alpha / 2)
    else:
        # The sums hold COARSE shapes of the first view of a pair and those of the second; then incidence, finer shapes,
        # which are left out, and the nuisance effects.
        column = np.arange(sums.residual.shape[1])
        coarse = sums.select((column <= 2 * COARSE) | (column >= len(column) - nuisance))
        likelihood = shared_error_likelihood(coarse, unconstrained, noise, nuisance, per_view=COARSE)
        shared = _cause_size(likelihood, SHARED, alpha / 2)
    by_view = per_view_is_clearer or (per_view.share > 0 and not shared.share)
    return FieldError(
        rms=noise * shared.share,
        rms_by_view=noise * per_view.share,
        gain=max(shared.gain, per_view.gain),
        over_noise=shared.over_noise or per_view.over_noise,
        by_view=by_view,
        with_time=per_view.share > 0 and _follows_time(by_causes.estimate(PER_VIEW, per_view.shares), alpha),
        map=field_map(measurement, sums, unconstrained, noise, nuisance) if shared.share and not by_view else None,
    )


@dataclass(frozen=True)
class _CauseSize:
    """How large errors of one cause are, as shares of the scanner's noise, and how clearly."""

    share: float  # 0 where not significantly above `ALARM_SHARE`
    shares: Array  # (C,) the likeliest of all causes
    gain: float  # log likelihood, nats, over that with at most `ALARM_SHARE`
    over_noise: bool  # significantly above the noise


def _cause_size(likelihood: SmoothErrorLikelihood, cause: int, alpha: float) -> _CauseSize:
    """Return the likeliest size of errors of one cause, 0 unless it is significantly above `ALARM_SHARE`.

    A likelihood ratio test at level `alpha`: the cause limited to `ALARM_SHARE` against free, the other causes free in
    both. `over_noise` is the same test against a share of 1. Sizes are shares of the scanner's noise.

    Args:
        cause: SHARED, INCIDENCE or PER_VIEW, a number of `likelihood.design`.
    """
    shares, free = likelihood.ml_shares()
    gain = 0.5 * (likelihood.ml_shares({cause: ALARM_SHARE})[1] - free)
    # The size lies on the boundary of what is allowed: half of the χ² of one degree of freedom (Self & Liang 1987).
    least = 0.5 * chi2_limit(2 * alpha, 1)
    if gain <= least:
        return _CauseSize(0.0, shares, gain, over_noise=False)
    over_noise = 0.5 * (likelihood.ml_shares({cause: 1.0})[1] - free) > least
    return _CauseSize(float(shares[cause]), shares, gain, over_noise)


def _shared_error_gain(likelihood: SmoothErrorLikelihood) -> float:
    """Return the log likelihood (nats) that free shared errors gain over shared errors of at most `ALARM_SHARE`.

    In both, errors of single views are at most `ALARM_SHARE`.
    """
    usual = {PER_VIEW: ALARM_SHARE}
    both_usual = usual | {SHARED: ALARM_SHARE}
    return 0.5 * (likelihood.ml_shares(both_usual)[1] - likelihood.ml_shares(usual)[1])


def _follows_time(errors: Array, alpha: float) -> bool:
    """Return whether smooth errors of the parts of a session have a linear trend: a permutation test at level `alpha`.

    The statistic is the norm of Σ order · errors over the parts.

    Args:
        errors: (parts · COARSE,) coefficients of the errors: `COARSE` numbers a part, the parts in the order of time.
    """
    parts = len(errors) // COARSE
    errors = errors.reshape(parts, -1)
    order = np.arange(parts) - (parts - 1) / 2
    generator = np.random.default_rng(parts)
    permuted = np.array([generator.permutation(order) for _ in range(_PERMUTATIONS)])
    trend = np.linalg.norm(order @ errors)
    p = (1 + np.sum(np.linalg.norm(permuted @ errors, axis=1) >= trend)) / (1 + _PERMUTATIONS)
    return bool(p < alpha)


def field_map(
    measurement: Measurement, sums: PointGram, unconstrained: UnconstrainedPoses, noise: float, nuisance: int = 0
) -> FieldMap | None:
    """Return a map of the error along the ray over the scanner's field; None where it explains too little.

    It has to explain `_MIN_FIELD_SHARE` of what smooth errors leave in the overlaps. What moving the views can do (a
    constant, slopes, a bowl) is projected out of the map.

    Args:
        sums: of `sum_smooth_errors` with errors of every view.
        noise: of the scanner along the ray, length_unit.
        nuisance: number of the last parameters of the sums, which may have any size.
    """
    likelihood = _coarse_fine_likelihood(sums, unconstrained, noise, nuisance)
    # Coarse and finer errors, each scaled by its likeliest size, become one cause of unit size; incidence is another.
    shares = likelihood.ml_shares()[0]
    coarse, fine, incidence = (share * columns for share, columns in zip(shares, likelihood.design, strict=True))
    sizes = np.repeat(shares[:2], [coarse.shape[1], fine.shape[1]])
    likelihood = replace(likelihood, design=(np.hstack([coarse, fine]), incidence))
    values = likelihood.estimate(0, np.ones(2))
    if _field_share(likelihood, values) < _MIN_FIELD_SHARE:
        return None
    half = half_field(measurement)
    scans = measurement.capture.scans
    # 1 where the scanner looks along its z, −1 where against it.
    forward = float(np.sign(np.median([np.median(scan.points[:, 2] - scan.eye[2]) for scan in scans])))
    x, y = (np.linspace(-h, h, _GRID_PLACES) for h in half)
    seen = _observed_places(measurement, x, y, forward)
    a, b = (way[seen] for way in np.meshgrid(x, y))
    rays = np.stack([a, b, np.ones_like(a)], axis=1)
    # The coefficients of coarse shapes are corrections, those of finer shapes errors: hence the opposite signs.
    signs = np.where(np.arange(FINE) < COARSE, -1.0, 1.0)
    size = signs * sizes[:FINE] * noise / robust_pass_share(unconstrained.overlaps)
    shapes = np.array(legendre_products(rays * [forward, forward, 1.0], half)).T * size
    shapes = project_out(np.column_stack([rays, a**2 + b**2]), shapes)
    covariance = likelihood.posterior_covariance(0, np.ones(2))[:FINE, :FINE]
    error, sigma = (np.full(seen.shape, np.nan) for _ in range(2))
    error[seen] = shapes @ values[:FINE]
    sigma[seen] = _SIGMA_FACTOR * np.sqrt(np.sum((shapes @ covariance) * shapes, axis=1))
    return FieldMap(x, y, error, sigma)


def _coarse_fine_likelihood(
    sums: PointGram, unconstrained: UnconstrainedPoses, noise: float, nuisance: int
) -> SmoothErrorLikelihood:
    """Return the likelihood of errors that all views share, with three causes: coarse shapes, finer ones, incidence.

    Coarse and finer are Legendre products over the field, of degree up to 3 and up to 6.

    Args:
        sums: of `sum_smooth_errors`, with errors of every view.
        noise: rms of the sensor along the ray, length_unit.
        nuisance: number of the last columns of the sums: effects that may have any size.
    """
    column = np.arange(sums.residual.shape[1])
    # Behind COARSE shapes of either view stand incidence, the others, nuisance; incidence is to come before nuisance.
    shapes, last = np.delete(column, 2 * COARSE), len(column) - nuisance - 1
    shared = sums.select(np.insert(shapes, last, 2 * COARSE))
    likelihood = shared_error_likelihood(shared, unconstrained, noise, nuisance, per_view=COARSE)
    over_field, incidence = likelihood.design
    return replace(likelihood, design=(over_field[:, :COARSE], over_field[:, COARSE:], incidence))


def _field_share(likelihood: SmoothErrorLikelihood, values: Array) -> float:
    """Return the share of the errors' effect on the overlaps, as χ², that errors along the ray over the field explain.

    Args:
        values: (K,) coefficients of the first cause, of which the first FINE are along the ray over the field.
    """
    effect = likelihood.design[0] @ values
    rest = effect - likelihood.design[0][:, :FINE] @ values[:FINE]
    chi2, chi2_of_rest = (float(np.sum(x**2 / likelihood.scatter)) for x in (effect, rest))
    return 1 - chi2_of_rest / chi2 if chi2 > 0 else 0.0


def robust_pass_share(overlaps: Overlaps) -> float:
    """Return the share of a small error that a fit with robust weights sees, over what one with fixed weights would.

    Robust weights fall as the error grows. The share is Σ dψ/de over Σ ψ/e of Tukey's ψ (Huber & Ronchetti 2009, 7.6),
    over all correspondences: 0.83 for normal noise.
    """
    root = np.sqrt(np.concatenate([tukey(m.residual, overlaps.gram.scale) for m in overlaps.matches]))
    weight = np.concatenate([m.weight for m in overlaps.matches])
    # With u = e/(c·sigma): the root is 1 − u², and dψ/de = (1 − u²)(1 − 5u²).
    return float(np.sum(weight * root * (5 * root - 4)) / np.sum(weight * root**2))


def _observed_places(measurement: Measurement, x: Array, y: Array, forward: float) -> Mask:
    """Return a mask (Y, X) over the grid of the field, True where the scans have enough points.

    Args:
        x, y: (X,), (Y,) places, x/|z| and y/|z| in the scanner's frame, in equal steps.
        forward: 1 where the scanner looks along its z axis, −1 where against it.
    """
    edges = [np.append(at, at[-1] + at[1] - at[0]) - (at[1] - at[0]) / 2 for at in (y, x)]
    counts = np.zeros((len(y), len(x)))
    for scan in measurement.capture.scans:
        away = scan.points - scan.eye
        slopes = forward * away[:, :2] / away[:, 2:]
        counts += np.histogram2d(slopes[:, 1], slopes[:, 0], bins=edges)[0]
    return counts > _MIN_POINT_DENSITY * counts.mean()
