"""What every scanner has: a smooth error over its field and over incidence, a fraction of its noise, in all views.

It repeats from view to view, so no number of views averages it out, and it pretends to be a small effect of the
scanner. Diagnosis counts it as known scatter: what an effect must exceed. Hand-eye and effects are no better known
than it lets them.
"""

from collections.abc import Sequence

import numpy as np
from numpy.polynomial import legendre
from scipy.optimize import minimize

from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.point_gram import PointGram, seen_twists, streamed

# Rms over the field, as a share of the scanner's noise along the ray: what an effect must exceed to be named. An
# effect of the scanner that is missing looks like a larger one, so this is not taken from the scans.
ALARM_SHARE = 0.5
# What counts in a covariance is taken from them, with a log-normal prior.
USUAL_SHARE, _SPREAD, _SHARES = 0.3, 0.7, (0.01, 10.0)
# Neighbouring distances share points and normals: so many times the variance of independent ones.
_CORRELATION = 3.0
# Combinations that the overlaps show less than this share of the clearest tell nothing.
_TOLD = 1e-6
_DEGREE = 3
# Corners are seen by few points.
_REACH = 0.98


def field_scatter(measurement: Measurement, freed: FreePoses, share: float | None = ALARM_SHARE) -> Array:
    """(6V, K) twists that the views show for one standard deviation of each of K independent smooth errors.

    Args:
        share: rms of the errors over the scanner's noise; None takes it from what the overlaps show.
    """
    capture, half = measurement.capture, _half_field(measurement)

    def of_points(v: int, index: Indices) -> Array:
        return _undone(capture.scans[v].points[index], measurement.scan_views[v].cosine[index], half)

    def of_targets() -> Array:
        assert capture.sightings is not None
        points = capture.sightings.points
        seen = capture.sightings.target >= 0
        # An empty slot has no ray; nobody knows at what slant a target was seen.
        flat = np.where(seen[..., None], points, [0.0, 0.0, 1.0]).reshape(-1, 3)
        moved = _undone(flat, np.ones(len(flat)), half).reshape(-1, *points.shape)
        return np.where(seen[..., None], moved, 0.0)

    sums = streamed(freed, capture.noise_factor, of_points, of_targets)
    twists = seen_twists(sums, freed)
    noise = float(np.nanmedian([scan.noise for scan in capture.scans]))
    if not np.isfinite(noise):
        return np.zeros_like(twists)
    return np.asarray(twists * noise * (_shown(sums, twists, freed, noise) if share is None else share))


def field_scatters(measurements: Sequence[Measurement], freed: Sequence[FreePoses]) -> list[Array]:
    """The same for every session of a rig, as large as each shows it."""
    return [field_scatter(measurement, f, None) for measurement, f in zip(measurements, freed, strict=True)]


def _shown(sums: PointGram, twists: Array, freed: FreePoses, noise: float) -> Array:
    """(K,) shares by the likelihood of what errors leave within the overlaps, beside free poses, and a prior.

    Errors f of variances S change the normal equations there by M f: Mf + noise is N(0, M S M + cσ²M). The field
    and the incidence are two causes, and need not be equally large.
    """
    g = freed.overlaps.gram
    own = twists.reshape(g.views, 6, -1)
    # What the poses do not follow: Σ g² less what moving the views takes away.
    followed = np.einsum("pik,pil->kl", sums.vector, own[g.pairs[:, 0]] - own[g.pairs[:, 1]])
    values, vectors = np.linalg.eigh(sums.square.sum(axis=0) - (followed + followed.T) / 2)
    keep = values > _TOLD * values[-1]
    values, told = values[keep], noise * values[keep, None] * vectors[:, keep].T
    seen = vectors[:, keep].T @ sums.residual.sum(axis=0)
    cause = np.arange(len(vectors)) == len(vectors) - 1  # incidence is the last

    def deviance(log_shares: Array) -> float:
        squares = np.exp(2 * log_shares)[cause.astype(np.int64)]
        spread = (told * squares) @ told.T + np.diag(_CORRELATION * g.variance * values)
        prior = (log_shares - np.log(USUAL_SHARE)) / _SPREAD
        return float(np.linalg.slogdet(spread)[1] + seen @ np.linalg.solve(spread, seen) + prior @ prior)

    bounds = [tuple(np.log(_SHARES))] * 2
    found = minimize(deviance, np.full(2, np.log(USUAL_SHARE)), method="L-BFGS-B", bounds=bounds)
    return np.asarray(np.exp(found.x)[cause.astype(np.int64)])


def _half_field(measurement: Measurement) -> Array:
    """(2,) x/z and y/z up to which the scanner sees."""
    slopes = np.concatenate([np.abs(scan.points[:, :2] / scan.points[:, 2:]) for scan in measurement.capture.scans])
    return np.asarray(np.maximum(np.quantile(slopes, _REACH, axis=0), 1e-6))


def _undone(points: Array, cosine: Array, half: Array) -> Array:
    """(K, N, 3) what undoes smooth errors along the rays of points (N, 3), scanner frame, per unit.

    Legendre products over the field, of unit rms together, and the slope with incidence.
    """
    a, b = np.clip(points[:, :2] / points[:, 2:] / half, -1.2, 1.2).T
    powers = [legendre.legvander(x, _DEGREE) * np.sqrt(2 * np.arange(_DEGREE + 1) + 1) for x in (a, b)]
    orders = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1) if 0 < i + j <= _DEGREE]
    weights = np.array([1.0 / (i + j) for i, j in orders])
    weights /= np.linalg.norm(weights)
    smooth = [w * powers[0][:, i] * powers[1][:, j] for w, (i, j) in zip(weights, orders, strict=True)]
    rays = points / np.linalg.norm(points, axis=1)[:, None]
    return np.asarray(-np.array([*smooth, 1 / cosine - 1])[..., None] * rays)
