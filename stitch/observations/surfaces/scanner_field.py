"""What every scanner has: a smooth error over its field and over incidence, a fraction of its noise, in all views.

It repeats from view to view, so no number of views averages it out, and it pretends to be a small effect of the
scanner. Diagnosis counts it as known scatter: what an effect must exceed. Hand-eye and effects are no better known
than it lets them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.optimize import minimize

from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.point_gram import PointGram, seen_twists, streamed
from stitch.statistics.tails import chi2_tail

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
    sums, twists, noise = _errors(measurement, freed)
    if not np.isfinite(noise):
        return np.zeros_like(twists)
    return np.asarray(twists * noise * (_Shown.of(sums, twists, freed, noise).shares if share is None else share))


def field_scatters(measurements: Sequence[Measurement], freed: Sequence[FreePoses]) -> list[Array]:
    """The same for every session of a rig, as large as each shows it."""
    return [field_scatter(measurement, f, None) for measurement, f in zip(measurements, freed, strict=True)]


@dataclass(frozen=True)
class FieldError:
    """The error along the ray that is the same in every view, over the scanner's field."""

    rms: float  # length_unit
    unusual: bool  # larger than every scanner's
    over_noise: bool  # more systematic than random


def field_error(measurement: Measurement, freed: FreePoses, alpha: float) -> FieldError:
    """What the overlaps show of it; what it exceeds at the level `alpha`."""
    sums, twists, noise = _errors(measurement, freed)
    if not np.isfinite(noise):
        return FieldError(0.0, False, False)
    shown = _Shown.of(sums, twists, freed, noise)
    (share, _), free = shown.likeliest(_SHARES[1])

    def exceeds(most: float) -> bool:
        # On the boundary of what is allowed: half of the χ² of one degree of freedom (Self & Liang 1987).
        return 0.5 * chi2_tail(shown.likeliest(most)[1] - free, 1) < alpha

    return FieldError(noise * float(share), exceeds(ALARM_SHARE), exceeds(1.0))


def _errors(measurement: Measurement, freed: FreePoses) -> tuple[PointGram, Array, float]:
    """Sums and twists (6V, K) of K smooth errors of unit size along the ray, and the noise there; NaN without scans."""
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
    return sums, seen_twists(sums, freed), float(np.nanmedian([scan.noise for scan in capture.scans]))


@dataclass(frozen=True)
class _Shown:
    """What smooth errors leave within the overlaps, beside free poses, and how likely that is for errors of some size.

    Errors f of variances S change the normal equations there by M f: Mf + noise is N(0, M S M + cσ²M). The field
    and the incidence are two causes, and need not be equally large.
    """

    seen: Array  # (n,) in the directions that the overlaps show
    told: Array  # (n, K) for errors as large as the noise
    scatter: Array  # (n,) variances of `seen` without errors

    @classmethod
    def of(cls, sums: PointGram, twists: Array, freed: FreePoses, noise: float) -> "_Shown":
        g = freed.overlaps.gram
        own = twists.reshape(g.views, 6, -1)
        # What the poses do not follow: Σ g² less what moving the views takes away.
        followed = np.einsum("pik,pil->kl", sums.vector, own[g.pairs[:, 0]] - own[g.pairs[:, 1]])
        values, vectors = np.linalg.eigh(sums.square.sum(axis=0) - (followed + followed.T) / 2)
        keep = values > _TOLD * values[-1]
        values, vectors = values[keep], vectors[:, keep]
        seen = vectors.T @ sums.residual.sum(axis=0)
        return cls(seen, noise * values[:, None] * vectors.T, _CORRELATION * g.variance * values)

    @property
    def shares(self) -> Array:
        """(K,) likeliest rms of the errors over the noise, with a prior of usual sizes."""

        def deviance(log_shares: Array) -> float:
            prior = (log_shares - np.log(USUAL_SHARE)) / _SPREAD
            return self._deviance(log_shares) + float(prior @ prior)

        bounds = [tuple(np.log(_SHARES))] * 2
        found = minimize(deviance, np.full(2, np.log(USUAL_SHARE)), method="L-BFGS-B", bounds=bounds)
        return np.asarray(np.exp(found.x)[self._cause])

    def likeliest(self, most: float) -> tuple[Array, float]:
        """Shares (2,) of field and incidence without a prior, the field's at most so large; and −2 log likelihood."""
        bounds = [np.log([_SHARES[0], most]), np.log(_SHARES)]
        # The likelihood is flat where errors are small: from the largest on.
        starts = [np.array([bounds[0][1], b]) for b in np.log([USUAL_SHARE, _SHARES[1]])]
        fits = [minimize(self._deviance, start, method="L-BFGS-B", bounds=bounds) for start in starts]
        best = min(fits, key=lambda fit: float(fit.fun))
        return np.exp(best.x), float(best.fun)

    @property
    def _cause(self) -> Indices:
        """(K,) 0 for the field, 1 for incidence, which is the last."""
        return np.append(np.zeros(self.told.shape[1] - 1, np.int64), 1)

    def _deviance(self, log_shares: Array) -> float:
        spread = (self.told * np.exp(2 * log_shares)[self._cause]) @ self.told.T + np.diag(self.scatter)
        return float(np.linalg.slogdet(spread)[1] + self.seen @ np.linalg.solve(spread, self.seen))


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
