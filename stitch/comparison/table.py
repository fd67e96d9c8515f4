"""A residual against one property, in bins."""

from dataclasses import dataclass

import numpy as np

from stitch.comparison.view_scatter import BinStatistics
from stitch.frames import Array

_FAIR = 50  # correspondences of a bin that may be called the worst


@dataclass(frozen=True)
class ResidualTable:
    """One property in bins; lengths in length_unit, counts of correspondences and of views."""

    name: str
    unit: str
    low: Array  # (B,) edges, or the number of the view or cell
    high: Array  # (B,)
    label: tuple[str, ...]  # (B,) names of views, pairs or cells; else empty
    mean: Array  # (B,) signed
    mean_sigma: Array
    rms: Array  # (B,)
    rms_sigma: Array
    count: Array
    views: Array
    p_value: Array  # (B,) of each mean, as if it were the only one

    @property
    def clearest(self) -> float:
        """Largest |mean| over its standard error; 0 where nothing is known."""
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.abs(self.mean) / self.mean_sigma
        return float(np.nanmax(np.where(np.isfinite(z), z, 0.0), initial=0.0))

    @property
    def least_p(self) -> float:
        """The smallest p-value of its means; 1 where nothing is known."""
        return float(np.nanmin(self.p_value, initial=1.0))

    def worst(self, at_most: int) -> list[int]:
        """Numbers of the bins of largest rms, of those with a fair count."""
        fair = self.count > np.minimum(_FAIR, np.median(self.count) / 4)
        return [int(i) for i in np.argsort(-np.nan_to_num(self.rms), kind="stable") if fair[i]][:at_most]


def table_of(
    name: str, unit: str, edges: tuple[Array, Array], label: tuple[str, ...], statistics: BinStatistics
) -> ResidualTable:
    """The table of bins with their statistics; `edges` are (B,) lower and (B,) upper ones."""
    return ResidualTable(name, unit, *edges, label, **vars(statistics))
