"""Smooth errors larger than every scanner has, as the overlaps show them: the same in every view, or not."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.model.model import Model
from stitch.model.point_slopes import PointSlopes
from stitch.model.term import Term
from stitch.observations.surfaces.errors_by_view import PER_VIEW, SHARED, view_error_likelihood
from stitch.observations.surfaces.field_map import FieldMap, field_map
from stitch.observations.surfaces.free_poses import UnconstrainedPoses
from stitch.observations.surfaces.point_gram import PointGram, apparent_twists
from stitch.observations.surfaces.scanner_field import ALARM_SHARE, shared_error_likelihood
from stitch.observations.surfaces.shown_errors import SHARE_BOUNDS, SmoothErrorLikelihood
from stitch.observations.surfaces.smooth_errors import COARSE, sum_smooth_errors
from stitch.statistics.tails import chi2_tail

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
        measurement, unconstrained, PointSlopes.about_model(measurement, model, nuisance_effects), per_view=True
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
