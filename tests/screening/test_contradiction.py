"""Scans of a plate that show it in two places, made by hand."""

import numpy as np

from stitch.numerics import frames
from stitch.screening.linkage import find_contradicting_views
from stitch.session.scan import prepare_scan

POSES = np.tile(np.eye(4), (3, 1, 1))
TOLERANCE, SIZE = 0.1, 100.0


def plate(x=(-40.0, 40.0), raised=0.0, of=lambda x, y: x > 0):
    """Points every 2 mm of a plate 300 mm before the scanner, some of them nearer."""
    x, y = (c.ravel() for c in np.meshgrid(np.arange(*x, 2.0), np.arange(-40.0, 40.0, 2.0)))
    return prepare_scan("plate", np.c_[x, y, 300.0 - raised * of(x, y)])


def asked(scan):
    return find_contradicting_views([plate(), scan, plate()], POSES, TOLERANCE, SIZE)


def test_plates_in_one_place_do_not_contradict():
    assert asked(plate()) == ()


def test_half_of_a_scan_that_stands_elsewhere_is_told_near_and_far():
    for raised in (-8.0, -1.0, 1.0, 5.0, 8.0):
        assert asked(plate(raised=raised)) == (1,)


def test_a_few_points_that_others_show_tell_nothing():
    """Of a scan beside the others they show one row alone, and that elsewhere."""
    beside = plate(x=(36.0, 60.0), raised=2.0, of=lambda x, y: (x < 40) & (np.abs(y) < 4))
    assert asked(beside) == ()


def test_groups_that_stand_apart_do_not_contradict_each_other():
    poses = POSES.copy()
    poses[2] = frames.exp(np.array([0, 0, 0, 0, 0, 3.0]))
    assert find_contradicting_views([plate()] * 3, poses, TOLERANCE, SIZE) == (2,)
    assert find_contradicting_views([plate()] * 3, poses, TOLERANCE, SIZE, groups=[(0, 1), (2,)]) == ()
