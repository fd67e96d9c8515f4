"""The smallest displacement of a view that its evidence admits: what only a weak direction seems to show is no size.

A scan that slides along the part, or that few holes keep from turning, comes to rest millimetres from where it belongs,
and where all scans slid together each stands off from its pose by that. The estimate of the test knows both: what the
views have in common, and how well each direction is held.
"""

import numpy as np
from scipy.optimize import brentq

from stitch.frames import Array
from stitch.integrity.blunders import FAMILY_WISE, Found, columns_of
from stitch.integrity.steps import Step
from stitch.integrity.view_test import Test, ViewModel, projector, test
from stitch.statistics.tails import f_limit


def least_displacement(
    model: ViewModel, found: Found, others: list[int], steps: tuple[Step, ...], view: int, middle: Array
) -> tuple[float, float]:
    """Rotation (rad) and shift of a view's middle (length_unit) by the smallest twist that may be its displacement.

    Args:
        found: the scatter of the poses.
        others: views that are off beside this one: they stay free.
        middle: (3,) of the view's points, reference frame.
    """
    under = projector(model, found.fit, columns_of(model, others, steps))
    tested = test(under, model.alone[view])
    twist = smallest(tested, under.degrees) / np.repeat([model.lever, 1.0], 3)
    return float(np.linalg.norm(twist[:3])), float(
        np.linalg.norm(twist[3:] + np.cross(twist[:3], middle - model.centre))
    )


def smallest(tested: Test, degrees: int) -> Array:
    """(6,) the displacement nearest to none, rotations in 1/lever, that the evidence tells from the estimate in no more
    than 1 % of cases; `degrees` of freedom under which the view was tested."""
    held, axes = np.linalg.eigh(tested.normal)
    held, seen = np.maximum(held, 0.0), axes.T @ tested.estimate
    limit = tested.degrees * f_limit(FAMILY_WISE, max(tested.degrees, 1), max(degrees - tested.degrees, 1))
    if held @ seen**2 <= limit:
        return np.zeros(6)

    def missed(log_pull: float) -> float:
        pull = np.exp(log_pull)
        return float(held @ (pull / (held + pull) * seen) ** 2 - limit)

    # A pull towards none moves the estimate the farther the less a direction is held.
    strongest = np.log(held[-1])
    pull = np.exp(brentq(missed, strongest - 60, strongest + 60))
    return np.asarray(axes @ (held / (held + pull) * seen))
