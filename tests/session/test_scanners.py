"""Sessions of several scanners joined: whose view is whose, in which order, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import stitch
from data_synth.cells.scanner_cell import scanner_cell, write_scanners
from stitch.errors import InputError
from stitch.session.scanners import have_own_hand_eyes, join_sessions, scanners_of, stops_of


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    cell = scanner_cell("rig", 5, views=4, rays=40)
    return [stitch.load_session(path) for path in write_scanners(tmp_path_factory.mktemp("cell"), cell)]


def named(session, name):
    return replace(session, scanner=replace(session.scanner, name=name))


def test_views_are_named_for_their_scanner_and_stand_in_the_order_of_time(pair):
    joined = join_sessions(pair)
    assert joined.names[:3] == ["v000@left", "v000@right", "v001@left"]
    assert [view.scanner for view in joined.views[:3]] == [0, 1, 0]


def test_the_second_scanner_stands_right_of_the_first_ones_hand_eye(pair):
    scanners = scanners_of(join_sessions(pair))
    found = pair[0].scanner.T_mount @ scanners.behind
    for T, k in zip(found, scanners.of_view, strict=True):
        assert np.allclose(T, pair[k].scanner.T_mount)


def test_sessions_of_one_scanner_are_not_joined_and_one_without_a_name_is_refused(pair):
    assert not have_own_hand_eyes([pair[0], named(pair[1], "left")])
    with pytest.raises(InputError, match="name every scanner"):
        have_own_hand_eyes([pair[0], named(pair[1], "")])
    with pytest.raises(InputError, match="one session a scanner"):
        have_own_hand_eyes([*pair, named(pair[1], "left")])


def test_scanners_at_one_stop_share_it_and_a_stop_that_is_driven_to_again_is_another(pair):
    joined = join_sessions(pair)
    assert stops_of(joined).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    # The right one scans when the left one is through: the arm has come back to every stop.
    late = [replace(view, time_s=view.time_s + 1000.0) for view in pair[1].views]
    assert stops_of(join_sessions([pair[0], replace(pair[1], views=tuple(late))])).tolist() == list(range(8))


def test_without_times_scanners_at_one_pose_saw_one_stop_and_a_second_scan_of_one_is_a_stop_more(pair):
    timeless = [replace(s, views=tuple(replace(view, time_s=None) for view in s.views)) for s in pair]
    assert stops_of(join_sessions(timeless)).tolist() == [0, 1, 2, 3] * 2
    twice = replace(timeless[0], views=timeless[0].views[:1] * 2)
    assert stops_of(join_sessions([twice, timeless[1]])).tolist() == [0, 1, 0, 2, 3, 4]
