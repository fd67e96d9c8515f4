"""The smallest rotation of a view and the smallest shift of what it shows that its evidence admits."""

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.blunders import BlunderSearch, free_view_columns
from stitch.integrity.smallest import rotation_shift_lower_bounds
from stitch.integrity.step import PoseStep
from stitch.integrity.view_model import ViewModel, projector
from stitch.integrity.view_test import test_alternative


def least_displacement(
    model: ViewModel, found: BlunderSearch, others: list[int], steps: tuple[PoseStep, ...], view: int, middle: Array
) -> tuple[float, float]:
    """The smallest rotation (rad) and the smallest shift of a view's middle (length_unit) that may be its displacement.

    Args:
        found: the scatter of the poses.
        others: views that are off beside this one: they stay free.
        middle: (3,) of the view's points, reference frame.
    """
    under = projector(model, found.fit, free_view_columns(model, others, steps))
    carried = np.eye(6)
    carried[3:, :3] = -frames.skew(middle - model.centre) / model.lever
    turn, shift = rotation_shift_lower_bounds(
        test_alternative(under, model.held_responses[view]), under.degrees, carried
    )
    return turn / model.lever, shift
