"""The smallest rotation of a view and the smallest shift of what it shows that its evidence admits."""

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.blunders import Found, columns_of
from stitch.integrity.smallest import smallest_parts
from stitch.integrity.step import Step
from stitch.integrity.view_model import ViewModel, projector
from stitch.integrity.view_test import test


def least_displacement(
    model: ViewModel, found: Found, others: list[int], steps: tuple[Step, ...], view: int, middle: Array
) -> tuple[float, float]:
    """The smallest rotation (rad) and the smallest shift of a view's middle (length_unit) that may be its displacement.

    Args:
        found: the scatter of the poses.
        others: views that are off beside this one: they stay free.
        middle: (3,) of the view's points, reference frame.
    """
    under = projector(model, found.fit, columns_of(model, others, steps))
    carried = np.eye(6)
    carried[3:, :3] = -frames.skew(middle - model.centre) / model.lever
    turn, shift = smallest_parts(test(under, model.alone[view]), under.degrees, carried)
    return turn / model.lever, shift
