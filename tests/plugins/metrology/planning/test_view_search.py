"""What further views add, and which are chosen: against normal equations written out, and against trying all."""

from itertools import combinations

import numpy as np
import pytest

from stitch.diagnosis.next_view import separations
from stitch.numerics import frames
from stitch.plugins.metrology.planning.information import TwistChannel, noise_of
from stitch.plugins.metrology.planning.plan import KnownPlace, choose_views, place_lever, travel_order


@pytest.fixture
def channel():
    rng = np.random.default_rng(0)
    half = rng.standard_normal((60, 60))
    return TwistChannel(half @ half.T + np.eye(60), rng.standard_normal((60, 9)))


def test_one_more_view_is_worth_what_the_whole_says(channel):
    rows = np.r_[0:12, 24:30, 48:54]
    inverse = np.linalg.inv(channel.covariance[np.ix_(rows, rows)])
    whole = channel.columns[rows].T @ inverse @ channel.columns[rows]
    np.testing.assert_allclose(channel.normal([0, 1, 4, 8]), whole, rtol=1e-9)
    np.testing.assert_allclose(channel.with_each([0, 1, 4], [2, 8])[1], whole, rtol=1e-9)


def test_a_pattern_keeps_what_its_rival_cannot_imitate(channel):
    """Least squares with a weak prior on the rival, column by column."""
    X = channel.columns
    left = separations(X.T @ X, slice(7, 9), slice(5, 7))
    rows = np.vstack([X[:, :7], np.hstack([np.zeros((2, 5)), 0.1 * np.eye(2)])])
    for k, y in enumerate(X[:, 7:].T):
        y = np.append(y, [0.0, 0.0])
        rest = y - rows @ np.linalg.lstsq(rows, y, rcond=None)[0]
        assert left[k] == pytest.approx(rest @ rest, rel=1e-6)


def test_what_a_view_does_not_see_is_as_good_as_unknown():
    information = np.diag([4.0, 4.0, 0.0, 1.0, 1.0, 1.0])[None]
    noise = np.diag(noise_of(information, variance=0.01, lever=2.0))
    np.testing.assert_allclose(noise[[0, 1, 3, 4, 5]], [0.0025, 0.0025, 0.01, 0.01, 0.01])
    assert noise[2] > 1e3


def test_the_chosen_views_are_the_best_there_are(channel):
    """Against all pairs of ten views beside the first; and driven the short way round."""
    joints = np.random.default_rng(1).uniform(-1, 1, (10, 6))
    goal = KnownPlace(channel, place_lever(np.array([0.0, 0.0, 1.0]), 9), now=1e3, share=1e-9)
    chosen = choose_views([goal], joints, present=3, most=2)
    best = min(float(goal.U(channel.normal([0, 1, 2, *pair]))) for pair in combinations(range(3, 10), 2))
    assert float(goal.U(channel.normal([0, 1, 2, *chosen]))) == pytest.approx(best, rel=0.02)
    assert travel_order(np.array([[0.0], [5.0], [1.0], [3.0]]), 0, [1, 2, 3]) == [2, 3, 1]


def test_the_lever_of_a_place_is_what_a_twist_moves_it_by():
    place, twist = np.array([40.0, -25.0, 300.0]), 1e-6 * np.array([3.0, -1.0, 2.0, 500.0, 100.0, -300.0])
    moved = frames.transform(frames.exp(twist), place[None])[0] - place
    np.testing.assert_allclose(place_lever(place, 15, 6)[:, 6:12] @ twist, moved, rtol=1e-4)
    assert not place_lever(place, 15, 6)[:, [*range(6), *range(12, 15)]].any()


def test_no_view_is_chosen_that_is_not_needed(channel):
    joints = np.zeros((10, 6))
    reached = float(
        np.min(KnownPlace(channel, place_lever(np.zeros(3), 9), 1.0).U(channel.with_each([0, 1, 2], range(3, 10))))
    )
    goal = KnownPlace(channel, place_lever(np.zeros(3), 9), now=reached / 0.5 * 1.001)
    assert len(choose_views([goal], joints, present=3, most=6)) == 1


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_where_there_is_no_hand_eye_yet_as_many_views_are_chosen_as_are_asked_for(channel, unit):
    """In any unit of length."""
    goal = KnownPlace(channel, place_lever(np.array([0.0, 0.0, unit]), 9), now=float("nan"))
    assert len(choose_views([goal], np.zeros((10, 6)), present=1, most=4)) == 4
