"""One scan pixel by pixel: where each pixel lies in space, and how bright it is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stitch.frames import Array


@dataclass(frozen=True)
class RangeImage:
    """An image of H rows and W columns; lengths in length_unit."""

    points: Array  # (H, W, 3) scanner frame; NaN where nothing was measured
    grey: NDArray[np.uint8]  # (H, W)
