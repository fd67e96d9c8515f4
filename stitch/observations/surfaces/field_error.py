"""Smooth errors larger than every scanner has, as the overlaps show them: the same in every view, or not."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.model.model import Model
from stitch.model.point_slopes import PointSlopes
from stitch.model.term import Term
from stitch.observations.surfaces.errors_by_view import CHANGING, SAME, by_view
from stitch.observations.surfaces.field_map import FieldMap, field_map
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.point_gram import PointGram, seen_twists
from stitch.observations.surfaces.scanner_field import ALARM_SHARE, alike
from stitch.observations.surfaces.shown_errors import SHARES, ShownErrors
from stitch.observations.surfaces.smooth_errors import COARSE, smooth_sums
from stitch.statistics.tails import chi2_tail

_ORDERS = 999


@dataclass(frozen=True)
class FieldError:
    """Errors along the ray that are smooth over the scanner's field; rms in length_unit, 0 where not unusual."""

    rms: float  # of what is the same in every view
    changing: float  # of what every view has for itself
    gain: float  # nats by which the clearer of both is likelier than the largest that every scanner has
    over_noise: bool  # one of the two is more systematic than random
    by_view: bool = False  # the second is the clearer
    with_time: bool = False  # it follows the session
    map: FieldMap | None = field(default=None, compare=False, repr=False)  # where the first is the clearer

    @property
    def unusual(self) -> bool:
        """Larger than every scanner's."""
        return self.rms > 0 or self.changing > 0


def field_error(
    measurement: Measurement, model: Model, freed: FreePoses, alpha: float, beside: Sequence[Term] = ()
) -> FieldError:
    """What the overlaps show of it; what it exceeds at the level `alpha`.

    Args:
        beside: effects of points that may have any size there.
    """
    sums, noise = smooth_sums(measurement, freed, PointSlopes.of(measurement, model, beside), apart=True)
    if not np.isfinite(noise):
        return FieldError(0.0, 0.0, 0.0, over_noise=False)
    further = sum(len(term.parameters) for term in beside)
    apart = by_view(sums, freed, noise, further)
    # Two questions, each at half of the level.
    changing = _size(apart, CHANGING, alpha / 2)
    # What all views have in common comes first: large errors of that kind move points to other partners, which looks
    # like errors of single views.
    alone = changing.share > 0 and changing.gain > _gain_of_common(apart)
    same = _size(apart if alone else _coarse(sums, freed, noise, further), SAME, alpha / 2)
    own = alone or (changing.share > 0 and not same.share)
    return FieldError(
        noise * same.share,
        noise * changing.share,
        max(same.gain, changing.gain),
        same.over_noise or changing.over_noise,
        own,
        changing.share > 0 and _with_time(apart.estimate(CHANGING, changing.shares), alpha),
        field_map(measurement, sums, freed, noise, further) if same.share and not own else None,
    )


@dataclass(frozen=True)
class _Size:
    """Of errors of one cause, in units of the noise."""

    share: float  # 0 where not unusual
    shares: Array  # (C,) the likeliest of all causes
    gain: float
    over_noise: bool


def _size(shown: ShownErrors, cause: int, alpha: float) -> _Size:
    """The likeliest size of errors of one cause beside the others, if it is unusual."""

    def clear(gain: float) -> bool:
        # On the boundary of what is allowed: half of the χ² of one degree of freedom (Self & Liang 1987).
        return 0.5 * chi2_tail(2 * gain, 1) < alpha

    shares, free = shown.likeliest(_most(shown, {}))

    def nats(share: float) -> float:
        return 0.5 * (shown.likeliest(_most(shown, {cause: share}))[1] - free)

    gain = nats(ALARM_SHARE)
    if not clear(gain):
        return _Size(0.0, shares, gain, over_noise=False)
    return _Size(float(shares[cause]), shares, gain, clear(nats(1.0)))


def _gain_of_common(apart: ShownErrors) -> float:
    """Nats that errors of all views gain over usual ones where those of single views are usual."""
    usual = {CHANGING: ALARM_SHARE}
    deviances = [apart.likeliest(_most(apart, limits))[1] for limits in (usual | {SAME: ALARM_SHARE}, usual)]
    return 0.5 * (deviances[0] - deviances[1])


def _most(shown: ShownErrors, limits: dict[int, float]) -> list[float]:
    """The largest share of each cause."""
    return [limits.get(cause, SHARES[1]) for cause in range(len(shown.told))]


def _coarse(sums: PointGram, freed: FreePoses, noise: float, beside: int) -> ShownErrors:
    """The same in every view, without the finer ones: what is known of it where no view has errors for itself."""
    together = sums.together(apart=COARSE)
    column = np.arange(together.residual.shape[1])
    coarse = together.of((column <= COARSE) | (column >= len(column) - beside))
    return alike(coarse, seen_twists(coarse, freed), freed, noise, beside)


def _with_time(errors: Array, alpha: float) -> bool:
    """True where errors of the views, part after part, follow their order more than other orders would have it."""
    parts = len(errors) // COARSE
    errors = errors.reshape(parts, -1)
    order = np.arange(parts) - (parts - 1) / 2
    generator = np.random.default_rng(parts)
    others = np.array([generator.permutation(order) for _ in range(_ORDERS)])
    trend = np.linalg.norm(order @ errors)
    return bool((1 + np.sum(np.linalg.norm(others @ errors, axis=1) >= trend)) / (1 + _ORDERS) < alpha)
