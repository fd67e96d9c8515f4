"""What one of two models leaves of the mean square error that the other leaves."""

import numpy as np
from scipy.special import ndtri

from stitch.frames import Array


def mean_square_share(with_it: Array, without: Array) -> tuple[float, float]:
    """What one model leaves over what another leaves, mean squares, and the standard error of that.

    Args:
        with_it: (G,) sum of squares of each sample, a group of views or one view, under the one.
        without: (G,) under the other.
    """
    share = float(with_it.sum() / max(without.sum(), 1e-300))
    spread = np.sum((with_it - share * without) ** 2) * len(without) / max(len(without) - 1, 1)
    return share, float(np.sqrt(spread) / max(without.sum(), 1e-300))


def significantly_smaller(squares: Array, others: Array, chance: float) -> bool:
    """True if the first are less by more than chance would make them; views where either is not finite do not count.

    Args:
        squares: (V,) mean square of each view under one model.
        others: (V,) under another.
        chance: one-sided, of the normal distribution.
    """
    seen = np.isfinite(squares) & np.isfinite(others)
    share, sigma = mean_square_share(squares[seen], others[seen])
    return bool(share < 1 - ndtri(1 - chance) * sigma)
