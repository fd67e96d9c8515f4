"""Units of positions and clouds by their sizes, and positions of a site."""

import numpy as np
import pytest

from stitch.plugins.intake.layouts import possible_layouts, unit_pairs
from stitch.plugins.intake.raw_poses import RawPoses

CLOUD = np.random.default_rng(0).uniform(-0.07, 0.07, (500, 3)) + np.array([0, 0, 0.42])  # m
REACH = np.array([[0.54, 0.21, 0.71], [0.9, -0.1, 0.7]])  # m


@pytest.mark.parametrize(
    ("poses", "clouds", "first"),
    [
        (1e3, 1e3, ("mm", "mm")),
        (1.0, 1.0, ("m", "m")),
        (1e3, 1.0, ("mm", "m")),
        (1e3, 1e2, ("mm", "cm")),
        (1 / 0.0254, 1 / 0.0254, ("inch", "inch")),
    ],
)
def test_units_are_those_of_a_usual_cell_under_which_the_motions_agree(poses, clouds, first):
    pairs = unit_pairs(REACH * poses, [CLOUD * clouds], poses / clouds)
    assert pairs[0] == first
    # A scale that is common to both is told by the usual size alone: cm compete with inches.
    assert (("cm", "cm") in pairs) == (first == ("inch", "inch"))


def test_what_all_positions_of_a_site_have_in_common_is_taken_off():
    site = np.array([403512.0, 5715430.0, 118.0])
    table = np.hstack([REACH + site, np.tile([0, 0, 0, 1.0], (2, 1))])
    header = ("x", "y", "z", "qx", "qy", "qz", "qw")
    (layout,) = possible_layouts(RawPoses("poses.csv", header, table, ((),) * 2, ""))
    assert np.abs(layout.position + layout.offset - table[:, :3]).max() < 1e-9
    assert np.abs(layout.position).max() < 2.0
    (near,) = possible_layouts(RawPoses("poses.csv", header, table - np.r_[site, np.zeros(4)], ((),) * 2, ""))
    assert near.offset == () and np.array_equal(near.position, table[:, :3] - site)
