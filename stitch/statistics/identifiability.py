"""Which parameters the views can know: absolute first, then beside the hand-eye and each other."""

import numpy as np
from scipy.linalg import qr

from stitch.frames import Array, Mask
from stitch.statistics.least_squares import column_space


def independent(base: Array, further: Array, sizes: Array, threshold: float) -> Mask:
    """(P,) bool: columns that stand out by at least `threshold` sigmas at their size, beside those chosen before.

    The clearest is chosen first (QR with pivoting), so that of two that say the same the better known stays.

    Args:
        base: (N, a) whitened columns that come first, whatever they say.
        further: (N, P) whitened columns per unit of their parameters.
        sizes: (P,) plausible sizes of the parameters.
    """
    rest = project_out(base, further * sizes)
    R, order = qr(rest, mode="r", pivoting=True)
    clear = np.abs(np.diag(R)) >= threshold
    chosen = np.zeros(further.shape[1], bool)
    chosen[order[: len(clear)][clear]] = True
    return chosen


def project_out(base: Array, columns: Array) -> Array:
    """What is left of `columns` beside the column space of `base`."""
    if not base.shape[1]:
        return columns
    U = column_space(base)
    return np.asarray(columns - U @ (U.T @ columns))
