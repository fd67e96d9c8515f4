"""A map of the smooth error that a scanner makes in every view alike: what the overlaps tell of it, place by place.

Overlaps show differences between views alone. On a part that is nearly flat, moving the views does what a constant or a
slope over the field does, and what a bowl does: seen from two places, its two images differ by a slope, however the
scanner is rolled. The map has none of them. Errors across the ray, or along the range, are no map over the field: where
they are most of what is shown, there is none.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stitch.frames import Array, Mask
from stitch.measurement.measurement import Measurement
from stitch.observations.surfaces.free_poses import UnconstrainedPoses
from stitch.observations.surfaces.overlaps import Overlaps
from stitch.observations.surfaces.point_gram import PointGram, apparent_twists
from stitch.observations.surfaces.scanner_field import shared_error_likelihood
from stitch.observations.surfaces.shown_errors import SHARE_BOUNDS, SmoothErrorLikelihood
from stitch.observations.surfaces.smooth_errors import COARSE, FINE, half_field, legendre_products
from stitch.statistics.identifiability import project_out
from stitch.statistics.robust import tukey

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
        sums: of `smooth_sums`, apart.
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
    return np.asarray(counts > _MIN_POINT_DENSITY * counts.mean())
