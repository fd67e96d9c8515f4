"""Rotations written with few decimals: what rounding does to poses, against poses before it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.screening.plausibility import find_rounding

EXACT = Rotation.random(400, rng=np.random.default_rng(3))


def poses(R):
    return frames.make(R.as_matrix(), np.zeros(3))


@pytest.mark.parametrize("decimals", [1, 2, 3])
def test_quaternions_of_few_decimals_turn_poses_by_what_is_said(decimals):
    rounded = Rotation.from_quat(np.round(EXACT.as_quat(), decimals))
    found = find_rounding(poses(rounded))
    assert (found.kind, found.decimals) == ("quaternion", decimals)
    turned = (rounded * EXACT.inv()).as_rotvec()
    assert found.rotation == pytest.approx(np.sqrt(np.mean(turned**2)), rel=0.1)


@pytest.mark.parametrize("order", ["ZYX", "xyz", "ZYZ"])
@pytest.mark.parametrize("decimals", [0, 1, 2])
def test_angles_of_few_decimals_turn_poses_by_what_is_said(order, decimals):
    rounded = Rotation.from_euler(order, np.round(EXACT.as_euler(order, degrees=True), decimals), degrees=True)
    found = find_rounding(poses(rounded))
    assert (found.kind, found.decimals) == ("euler", decimals)
    turned = (rounded * EXACT.inv()).as_rotvec()
    assert found.rotation == pytest.approx(np.sqrt(np.mean(turned**2)), rel=0.1)


def test_numbers_of_nine_decimals_and_poses_that_never_turn_are_not_rounded():
    assert find_rounding(poses(Rotation.from_quat(np.round(EXACT.as_quat(), 9)))) is None
    assert find_rounding(np.tile(np.eye(4), (5, 1, 1))) is None
