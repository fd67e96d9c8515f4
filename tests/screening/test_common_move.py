"""A base that moved is told from an arm that is bad."""

from dataclasses import replace

import numpy as np
import pytest

from bench.real_arms import WORLDS, bad_arm
from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.screening.common_move import find_common_move
from stitch.session.capture import prepare_capture


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("seed", [40, 41])
def test_a_bad_arm_is_neither_refused_nor_said_to_have_moved(world, seed):
    assert bad_arm({"world": world, "times": 0.0, "seed": seed})["found"] == []


@pytest.mark.parametrize("world", WORLDS)
def test_a_move_of_eight_times_its_error_is_named_with_the_view(world):
    assert bad_arm({"world": world, "times": 8.0, "seed": 42})["moved"]


@pytest.mark.parametrize(("by", "sure"), [(0.3, True), (0.06, False)])
def test_a_move_of_the_arms_own_size_is_a_doubt(by, sure):
    session, *_ = labelled_cell(3, views=60, mount="eye_in_hand")
    views = list(session.views)
    for v in range(25, 60):
        T = np.array(views[v].T_base_flange)
        T[:3, 3] += [by, 0, 0]
        views[v] = replace(views[v], T_base_flange=T, joints=None)
    move = find_common_move(prepare_capture(replace(session, views=tuple(views))))
    assert move is not None and abs(move.start - 25) <= 1
    assert move.is_sure == sure and move.moved == pytest.approx(by, abs=0.04)


def test_of_few_views_no_move_is_asked():
    assert find_common_move(prepare_capture(labelled_cell(3, views=7)[0])) is None
