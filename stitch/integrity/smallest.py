"""The smallest displacement that evidence admits: what only a weak direction seems to show is no size.

A scan that slides along the part, or that few holes keep from turning, comes to rest millimetres from where it belongs,
and where all scans slid together each stands off from its pose by that. The estimate of the test knows both: what the
views have in common, and how well each direction is held.
"""

import numpy as np
from scipy.optimize import brentq

from stitch.frames import Array
from stitch.integrity.view_test import AlternativeTest
from stitch.statistics.tails import f_limit

# Chance that the evidence tells it from the right one.
_CHANCE = 0.01


def displacement_lower_bound(tested: AlternativeTest, degrees: int) -> Array:
    """(6,) the displacement nearest to none, rotations in 1/lever, that the evidence tells from the estimate in no more
    than 1 % of cases; `degrees` of freedom under which the view was tested."""
    return _shortest_within_limit(tested.normal, tested.estimate, _confidence_limit(tested, degrees))


def rotation_shift_lower_bounds(tested: AlternativeTest, degrees: int, carried: Array) -> tuple[float, float]:
    """The smallest rotation, in 1/lever, and the smallest shift, whatever the other one is.

    Args:
        carried: (6, 6) from displacements as they were tested to those of the point whose shift counts.
    """
    back = np.linalg.inv(carried)
    N, estimate, limit = back.T @ tested.normal @ back, carried @ tested.estimate, _confidence_limit(tested, degrees)
    parts = []
    for own, other in ((slice(0, 3), slice(3, 6)), (slice(3, 6), slice(0, 3))):
        left = N[own, own] - N[own, other] @ np.linalg.pinv(N[other, other], rcond=1e-9, hermitian=True) @ N[other, own]
        parts.append(float(np.linalg.norm(_shortest_within_limit(left, estimate[own], limit))))
    return parts[0], parts[1]


def _confidence_limit(tested: AlternativeTest, degrees: int) -> float:
    return tested.degrees * f_limit(_CHANCE, max(tested.degrees, 1), max(degrees - tested.degrees, 1))


def _shortest_within_limit(normal: Array, estimate: Array, limit: float) -> Array:
    """(k,) the shortest displacement of which the evidence (k, k) is within a limit of that of the estimate (k,)."""
    held, axes = np.linalg.eigh(normal)
    held, seen = np.maximum(held, 0.0), axes.T @ estimate
    if held @ seen**2 <= limit:
        return np.zeros(len(seen))

    def missed(log_pull: float) -> float:
        pull = np.exp(log_pull)
        return float(held @ (pull / (held + pull) * seen) ** 2 - limit)

    # A pull towards none moves the estimate the farther the less a direction is held.
    strongest = np.log(held[-1])
    pull = np.exp(brentq(missed, strongest - 60, strongest + 60))
    return np.asarray(axes @ (held / (held + pull) * seen))
