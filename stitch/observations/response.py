"""How what was seen answers to the parameters of one effect."""

from dataclasses import dataclass
from typing import Protocol

from stitch.frames import Array, Mask


class PointSums(Protocol):
    """Sums of what the parameters of an effect do to the points themselves."""

    def select(self, keep: slice | Mask) -> "PointSums":
        """The sums of some of the parameters."""
        ...


@dataclass(frozen=True)
class CoefficientPrior:
    """What is believed of k coefficients before anything is seen."""

    precision: Array  # (k,) 0 where nothing is believed
    mean: Array  # (k,)


@dataclass(frozen=True)
class Response:
    """Columns of P parameters in the coordinates of an observation: twists of the views, or rows of targets."""

    columns: Array  # (·, P) per unit of each parameter
    points: PointSums | None = None  # of an effect that changes the points, where the columns do not say it all
