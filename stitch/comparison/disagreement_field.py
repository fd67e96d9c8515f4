"""The field of disagreement: per place of the part, how far each view puts the surface from where the others put it.

The distance of two matched points carries the noise of both. Averaged over a patch (`patches.py`) the noise goes and
what repeats stays: the error of the model as it shows on the part.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.frames import Array

# A colour bar shows so many steps that people tell apart.
COLOUR_STEPS = 10
# Mean of |x| of a normal x of unit sigma.
_MEAN_OF_NORMAL = float(np.sqrt(2 / np.pi))


@dataclass(frozen=True)
class DisagreementField:
    """Signed distances of V views at K patches, positive outwards; NaN where a view and no other sees the patch."""

    values: Array  # (V, K) length_unit
    sigma: Array  # (V, K) standard errors

    @cached_property
    def overall(self) -> Array:
        """(K,) mean of |value| over the views that see a patch; NaN where they are fewer than two."""
        return _mean_over_views(np.abs(self.values))

    @cached_property
    def by_view(self) -> Array:
        """(V,) mean of |value| over the patches that a view sees; NaN where it sees none with others."""
        seen = np.isfinite(self.values)
        count = seen.sum(axis=1)
        return np.where(count > 0, np.where(seen, np.abs(self.values), 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)

    @property
    def mean_abs(self) -> float:
        """Mean of |value| over the part."""
        return float(np.nanmean(self.overall)) if np.isfinite(self.overall).any() else float("nan")

    @property
    def noise(self) -> float:
        """What `mean_abs` would be if noise were all there is."""
        if not np.isfinite(self.sigma).any():
            return float("nan")
        return _MEAN_OF_NORMAL * float(np.nanmean(_mean_over_views(self.sigma)))

    def quantile(self, share: float = 0.95) -> float:
        """The distance that this share of the part keeps."""
        seen = self.overall[np.isfinite(self.overall)]
        return float(np.quantile(seen, share)) if len(seen) else float("nan")


def full_colour_distance(field: DisagreementField) -> float:
    """Distance at which colours are full: no step of them is smaller than the standard error of nearly all patches."""
    return max(field.quantile(), COLOUR_STEPS * largest_standard_error(field.sigma))


def largest_standard_error(sigma: Array) -> float:
    """What nearly all standard errors stay below."""
    return float(np.nanquantile(sigma, 0.9))


def _mean_over_views(values: Array) -> Array:
    """(K,) over the views (V, K) that see a patch; NaN where they are fewer than two."""
    seen = np.isfinite(values)
    count = seen.sum(axis=0)
    return np.where(count > 1, np.where(seen, values, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)
