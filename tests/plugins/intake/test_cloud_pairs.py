"""Clouds and poses find each other by name, by time, by number, by order.

Rows of a recording that belong to scans, by clocks that differ.

Motions of the scanner from targets that two views share.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.plugins.intake.cloud_pairs import clouds_served, pairings
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import StatedTable
from stitch.plugins.intake.scan_targets import target_motions
from stitch.plugins.intake.stops import rows_with_scans
from stitch.session.session import Sighting

CLOUDS = [Path(f"scans/view_{i:02d}.ply") for i in (1, 2, 3, 10)]
BEGIN = 1.7e9
FLAT = np.array([[0.0, 0, 0], [100, 0, 0], [100, 70, 0], [0, 70, 0], [50, 30, 0]])


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


def test_a_row_that_is_written_twice_counts_once_and_two_poses_of_one_name_are_none():
    labels = [(cloud.stem,) for cloud in (*CLOUDS, CLOUDS[1])]
    numbers = np.arange(6.0 * len(labels)).reshape(-1, 6)
    assert pairings(CLOUDS, labels, numbers)[0].rows == (0, None, *range(2, len(CLOUDS)))
    numbers[-1] = numbers[1]
    (pairing,) = pairings(CLOUDS, labels, numbers)
    assert pairing.rows == tuple(range(len(CLOUDS)))


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


SCANS = [Path(f"scan_2026-04-03_09-{minute}-07.ply") for minute in (12, 13, 15)]


@pytest.mark.parametrize("day", ["2026-04-03T", "03.04.2026 ", ""])
def test_times_tell_though_there_are_more_poses(day):
    times = ["09:11:50", "09:12:06.5", "09:13:07", "09:14:00", "09:15:08", "09:16:00"]
    (pairing,) = pairings(SCANS, [(f"{day}{time}",) for time in times])
    assert pairing.rows == (1, 2, 4) and pairing.by_name and "1 s at most" in pairing.words
    assert "3 poses belong to no cloud" in pairing.words


@pytest.mark.parametrize(
    "times",
    [
        ["09:12:07", "09:13:07", "09:14:07", "09:14:30", "09:14:40", "09:14:50"],  # the last scan has no pose
        ["10:12:07", "10:13:07", "10:15:07", "10:16:00", "10:17:00", "10:18:00"],  # another hour
        ["09:12:07", "09:12:07", "09:12:07", "09:12:07", "09:12:07", "09:12:07"],
    ],
)
def test_times_that_are_not_those_of_the_scans_tell_nothing(times):
    with pytest.raises(InputError, match="3 clouds and 6 poses"):
        pairings(SCANS, [(time,) for time in times])


@pytest.mark.parametrize("scale", [1.0, 1e3, 1e9])
def test_a_trajectory_at_a_hundred_hertz_is_met_where_a_scan_was_taken(scale):
    """Images and ground truth as the TUM RGB-D benchmark names them: seconds since 1970, many more poses than images."""
    taken = [1305031453.374112, 1305031460.91, 1305031471.002]
    clouds = [Path(f"depth/{t:.6f}.png") if scale == 1 else Path(f"depth_{round(t * scale)}.ply") for t in taken]
    times = 1305031450 + 0.01 * np.arange(2500)
    table = np.column_stack([times * scale, *np.random.default_rng(0).normal(size=(7, 2500))])
    (pairing,) = pairings(clouds, [()] * len(table), table)
    assert pairing.rows == tuple(round((t - times[0]) / 0.01) for t in taken) and pairing.by_name
    with pytest.raises(InputError, match="3 clouds and 2500 poses"):
        pairings(clouds, [()] * len(table), table + 3600 * scale)


def test_of_numbered_clouds_a_row_too_many_may_stand_anywhere():
    clouds = [Path(f"scan_{i:02d}.ply") for i in range(1, 6)]
    rows = {pairing.rows for pairing in pairings(clouds, [()] * 6)}
    assert {(0, 1, 2, 3, 4), (1, 2, 3, 4, 5), (0, 1, 3, 4, 5)} <= rows


def test_names_that_pair_most_clouds_tell():
    clouds = [Path(f"p{i:02d}.ply") for i in range(1, 13)]
    labels = [(f"P{i}",) for i in range(1, 13)]
    (pairing,) = pairings(clouds, labels)
    assert pairing.rows == tuple(range(12))


@pytest.mark.parametrize(("rows", "served"), [(1, 0), (3, 3), (5, 4), (4, 4), (400, 3)])
def test_a_list_serves_the_clouds_that_it_can_be_paired_with(rows, served):
    assert min(clouds_served(CLOUDS, [()] * rows), 4) == served


@pytest.mark.parametrize("offset", [0.0, 2.6, -3.1])
def test_one_offset_of_the_clocks_puts_every_scan_into_a_rest_of_the_arm(offset):
    random = np.random.default_rng(3)
    places = random.uniform(300, 900, (9, 3))
    times = BEGIN + np.arange(0, 80, 0.5)
    # Six seconds of rest, four of motion.
    step = np.clip((times - BEGIN) % 10 - 6, 0, None)[:, None] / 4
    stop = ((times - BEGIN) // 10).astype(int)
    positions = places[stop] * (1 - step) + places[stop + 1] * step
    numbers = np.column_stack([times, positions, np.tile([0, 0, 0, 1.0], (len(times), 1))])
    header = ("timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")
    raw = RawPoses("log.csv", header, numbers, ((),) * len(times), "")
    taken = BEGIN + 10 * np.arange(8) + 3 + random.uniform(-2, 2, 8)
    clouds = [Path(f"scan_{time + offset:.3f}.ply") for time in taken]
    rows = rows_with_scans(raw, clouds, None, StatedTable())
    if not offset:
        assert rows is raw
    else:
        assert "clock of the scans" in rows.words
        assert np.allclose(rows.numbers[:, 1:4], places[:8])


def sighting(T_scanner_part, points, names=None):
    names = tuple(f"t{i}" for i in range(len(points))) if names is None else names
    return Sighting(names, frames.transform(T_scanner_part, points), np.full(len(points), 0.01))


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    return frames.make(Rotation.from_rotvec(rng.normal(0, 0.5, (3, 3))).as_matrix(), rng.normal(0, 100, (3, 3)))


def test_points_of_a_plane_give_the_motions(poses):
    found = target_motions([sighting(T, FLAT) for T in poses])
    assert found.pairs == ((0, 1), (0, 2), (1, 2))
    for (v, w), T in zip(found.pairs, found.T, strict=True):
        assert np.allclose(T, poses[v] @ frames.inverse(poses[w]), atol=1e-9)


def test_names_pair_them_whatever_their_order(poses):
    order = [4, 2, 0, 1]
    second = sighting(poses[1], FLAT[order], tuple(f"t{i}" for i in order))
    found = target_motions([sighting(poses[0], FLAT), second])
    assert np.allclose(found.T[0], poses[0] @ frames.inverse(poses[1]), atol=1e-9)


def test_points_in_one_line_or_too_few_say_nothing(poses):
    line = np.outer(np.arange(5.0), [10, 20, 5])
    assert not target_motions([sighting(T, line) for T in poses]).pairs
    assert not target_motions([sighting(T, FLAT[:2]) for T in poses]).pairs
    others = sighting(poses[1], FLAT, tuple("abcde"))
    assert not target_motions([sighting(poses[0], FLAT), others]).pairs
