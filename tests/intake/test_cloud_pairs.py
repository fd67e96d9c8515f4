"""Clouds and poses find each other by name, by number, by order."""

from pathlib import Path

import pytest

from stitch.errors import InputError
from stitch.intake.cloud_pairs import pairings

CLOUDS = [Path(f"scans/view_{i:02d}.ply") for i in (1, 2, 3, 10)]


@pytest.mark.parametrize(
    ("labels", "rows"),
    [
        ([("view_10.ply",), ("view_03.ply",), ("view_02.ply",), ("view_01.ply",)], (3, 2, 1, 0)),
        ([("a", r"C:\scans\VIEW_02.PLY"), ("b", "view_01"), ("c", "view_10"), ("d", "view_03")], (1, 0, 3, 2)),
        ([("robot_pose_2",), ("robot_pose_1",), ("robot_pose_3",), ("robot_pose_10",)], (1, 0, 2, 3)),
        ([("p1",), ("p2",), ("p3",), ("p4",), ("p10",)], (0, 1, 2, 4)),
    ],
)
def test_names_tell(labels, rows):
    (pairing,) = pairings(CLOUDS, labels)
    assert pairing.rows == rows and pairing.by_name


def test_without_names_the_order_comes_first_then_what_people_do_wrong():
    found = pairings(CLOUDS, [()] * 4)
    assert found[0].rows == (0, 1, 2, 3) and found[1].rows == (3, 2, 1, 0)
    assert not any(p.by_name for p in found)


def test_a_failed_scan_leaves_every_gap_open():
    found = pairings(CLOUDS, [()] * 5)
    assert {p.rows for p in found} == {(1, 2, 3, 4), (0, 2, 3, 4), (0, 1, 3, 4), (0, 1, 2, 4), (0, 1, 2, 3)}


def test_lists_that_do_not_belong_together_are_refused():
    with pytest.raises(InputError, match="4 clouds and 9 poses"):
        pairings(CLOUDS, [()] * 9)
