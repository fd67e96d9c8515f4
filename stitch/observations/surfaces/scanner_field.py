"""What every scanner has: a smooth error over its field and over incidence, a fraction of its noise, in all views.

It repeats from view to view, so no number of views averages it out, and it pretends to be a small effect of the
scanner. Diagnosis counts it as known scatter: what an effect must exceed. Hand-eye and effects are no better known
than it lets them.
"""

from collections.abc import Sequence

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.observations.surfaces.free_poses import UnconstrainedPoses, visible_step
from stitch.observations.surfaces.point_gram import PointGram, apparent_twists
from stitch.observations.surfaces.shown_errors import SmoothErrorLikelihood
from stitch.observations.surfaces.smooth_errors import sum_smooth_errors

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
        return np.asarray(twists * noise * share)
    field, incidence = shared_error_likelihood(sums, twists, unconstrained, noise).map_shares
    return np.asarray(twists * noise * np.append(np.full(twists.shape[1] - 1, field), incidence))


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
