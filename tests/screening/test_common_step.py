"""Views that stand off alike are one event; views that stand off each its own way are not."""

import numpy as np
import pytest

from stitch.numerics import frames
from stitch.screening.pairing import find_common_displacement
from stitch.screening.snooping import MisplacedView

SLIP = np.array([0.05, -0.03, 0.02, 3.0, -5.0, 2.0])


def standing(view, T):
    return MisplacedView(view, "displaced", 0.1, 5.0, 0.0, T)


@pytest.mark.parametrize("views", [range(2, 5), range(3)])
@pytest.mark.parametrize("what", ["part", "scanner"])
def test_a_common_displacement_is_one_step(blade_capture, what, views):
    measured, capture = blade_capture
    poses = capture.poses(measured.T_mount)
    moved = {v: frames.exp(SLIP) @ poses[v] if what == "part" else poses[v] @ frames.exp(SLIP) for v in views}
    assert find_common_displacement(capture, poses, [standing(v, T) for v, T in moved.items()]) == (views, what)


def test_views_that_go_each_its_own_way_are_no_step(blade_capture):
    measured, capture = blade_capture
    poses, rng = capture.poses(measured.T_mount), np.random.default_rng(1)
    own = [standing(v, frames.exp(rng.normal(0, [0.05] * 3 + [5.0] * 3)) @ poses[v]) for v in (2, 3, 4)]
    assert find_common_displacement(capture, poses, own) is None


def test_two_views_or_views_in_the_middle_are_no_step(blade_capture):
    measured, capture = blade_capture
    poses = capture.poses(measured.T_mount)
    for views in ((3, 4), (1, 2, 3)):
        assert (
            find_common_displacement(capture, poses, [standing(v, frames.exp(SLIP) @ poses[v]) for v in views]) is None
        )
