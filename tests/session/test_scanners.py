"""Sessions of several scanners joined: whose view is whose, in which order, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import stitch
from data_synth.cells.scanner_cell import scanner_cell, write_scanners
from stitch.errors import InputError
from stitch.session.scanners import have_own_hand_eyes, join_sessions, scanners_of


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    cell = scanner_cell("rig", 5, views=4)
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
