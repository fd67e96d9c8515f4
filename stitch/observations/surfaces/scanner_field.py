"""What every scanner has: a smooth error over its field and over incidence, a fraction of its noise, in all views.

It repeats from view to view, so no number of views averages it out, and it pretends to be a small effect of the
scanner. Diagnosis counts it as known scatter: what an effect must exceed. Hand-eye and effects are no better known
than it lets them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.model.model import Model
from stitch.model.point_slopes import PointSlopes
from stitch.model.term import Term
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.point_gram import seen_twists
from stitch.observations.surfaces.shown_errors import SHARES, ShownErrors
from stitch.observations.surfaces.smooth_errors import smooth_sums
from stitch.statistics.tails import chi2_tail

# Rms over the field, as a share of the scanner's noise along the ray: what an effect must exceed to be named. An
# effect of the scanner that is missing looks like a larger one, so this is not taken from the scans.
ALARM_SHARE = 0.5


def field_scatter(measurement: Measurement, freed: FreePoses, share: float | None = ALARM_SHARE) -> Array:
    """(6V, K) twists that the views show for one standard deviation of each of K independent smooth errors.

    Args:
        share: rms of the errors over the scanner's noise; None takes it from what the overlaps show.
    """
    sums, noise = smooth_sums(measurement, freed)
    twists = seen_twists(sums, freed)
    if not np.isfinite(noise):
        return np.zeros_like(twists)
    if share is None:
        return np.asarray(twists * noise * ShownErrors.of(sums, twists, freed.overlaps.gram, noise).shares)
    return np.asarray(twists * noise * share)


def field_scatters(measurements: Sequence[Measurement], freed: Sequence[FreePoses]) -> list[Array]:
    """The same for every session of a rig, as large as each shows it."""
    return [field_scatter(measurement, f, None) for measurement, f in zip(measurements, freed, strict=True)]


@dataclass(frozen=True)
class FieldError:
    """The error along the ray that is the same in every view, over the scanner's field."""

    rms: float  # length_unit
    gain: float  # nats by which that is likelier than the largest that every scanner has
    unusual: bool  # larger than that
    over_noise: bool  # more systematic than random


def field_error(
    measurement: Measurement, model: Model, freed: FreePoses, alpha: float, beside: Sequence[Term] = ()
) -> FieldError:
    """What the overlaps show of it; what it exceeds at the level `alpha`.

    Args:
        beside: effects of points that may have any size there.
    """
    sums, noise = smooth_sums(measurement, freed, PointSlopes.of(measurement, model, beside))
    if not np.isfinite(noise):
        return FieldError(0.0, 0.0, unusual=False, over_noise=False)
    further = sum(len(term.parameters) for term in beside)
    shown = ShownErrors.of(sums, seen_twists(sums, freed), freed.overlaps.gram, noise, further)
    (share, _), free = shown.likeliest(SHARES[1])
    gain, over_noise = (0.5 * (shown.likeliest(most)[1] - free) for most in (ALARM_SHARE, 1.0))
    # On the boundary of what is allowed: half of the χ² of one degree of freedom (Self & Liang 1987).
    unusual, over = (0.5 * chi2_tail(2 * nats, 1) < alpha for nats in (gain, over_noise))
    return FieldError(noise * float(share), gain, unusual, over)
