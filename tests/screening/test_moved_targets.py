"""Targets that sit elsewhere from some view on, among points whose every place is known."""

import numpy as np
import pytest

from stitch.screening.moved_targets import find_moved_targets
from tests.screening.targets import PLACES, SIGMA, VIEWS, sightings


def moved(k, start, by, places=PLACES, views=VIEWS):
    out = np.tile(places, (views, 1, 1))
    out[start:, k] += by
    return out


@pytest.mark.parametrize(("k", "start"), [(0, 5), (3, 2), (4, 12)])
def test_a_target_that_moved_is_named_with_the_view_and_the_size(k, start):
    by = np.array([0.8, -1.2, 1.0])
    (found,) = find_moved_targets(sightings(moved(k, start, by)))
    others = np.delete(PLACES, k, axis=0)
    change = np.linalg.norm(PLACES[k] + by - others, axis=1) - np.linalg.norm(PLACES[k] - others, axis=1)
    assert (found.target, found.start) == (f"ball{k + 1}", start)
    assert found.distance == pytest.approx(np.abs(change).max(), abs=3 * SIGMA)


def test_two_that_moved_at_different_times_are_both_named():
    places = moved(1, 4, np.array([0, 0, 3.0]))
    places[9:, 2] += [2.0, 0, 0]
    assert sorted((m.target, m.start) for m in find_moved_targets(sightings(places))) == [("ball2", 4), ("ball3", 9)]


def test_among_three_targets_the_one_is_told_too():
    (found,) = find_moved_targets(sightings(moved(2, 6, np.array([1.0, 1.0, 0]), PLACES[:3])))
    assert (found.target, found.start) == ("ball3", 6)


def test_a_long_session_is_searched_ever_closer():
    (found,) = find_moved_targets(sightings(moved(0, 731, np.array([0.5, 0, 0.5]), views=1000)))
    assert (found.target, found.start) == ("ball1", 731)


@pytest.mark.parametrize("seed", range(20))
def test_targets_that_stay_are_not_accused(seed):
    rng = np.random.default_rng([seed, 1])
    unseen = [(v, int(rng.integers(5))) for v in range(VIEWS)]
    assert find_moved_targets(sightings(np.tile(PLACES, (VIEWS, 1, 1)), seed, unseen)) == ()


def test_what_grows_alike_is_no_target_that_moved():
    """A scanner that warms up lengthens all distances."""
    grown = PLACES * np.linspace(1, 1.002, VIEWS)[:, None, None]
    assert find_moved_targets(sightings(grown)) == ()


@pytest.mark.parametrize("k", range(12))
def test_among_a_dozen_a_large_move_is_told_whichever_it_is(k):
    """What it does to its own scatter does not put it behind those whose distance to it alone changes."""
    places = np.random.default_rng(5).uniform(-300, 300, (12, 3))
    (found,) = find_moved_targets(sightings(moved(k, 7, np.array([8.0, -12.0, 10.0]), places)))
    assert (found.target, found.start) == (f"ball{k + 1}", 7)


@pytest.mark.parametrize("seed", range(5))
def test_one_of_hundreds_of_targets_is_told(seed):
    """Every view shows a third of them; all pairs of them would be too many to compare."""
    rng, views, count = np.random.default_rng([seed, 2]), 40, 150
    places = rng.uniform(-300, 300, (count, 3))
    unseen = [(v, int(k)) for v in range(views) for k in rng.permutation(count)[: 2 * count // 3]]
    (found,) = find_moved_targets(sightings(moved(31, 18, np.array([0.3, 0.2, -0.3]), places, views), seed, unseen))
    assert found.target == "ball32" and not found.drifts
    # Where no view shows it, no view tells when it moved.
    shown = [v for v in range(views) if (v, 31) not in unseen]
    assert max([v for v in shown if v < 18]) < found.start <= min(v for v in shown if v >= 18)


@pytest.mark.parametrize("seed", range(5))
def test_none_of_hundreds_of_targets_that_stay_is_accused(seed):
    rng = np.random.default_rng([seed, 3])
    places = np.tile(rng.uniform(-300, 300, (120, 3)), (30, 1, 1))
    unseen = [(v, int(k)) for v in range(30) for k in rng.permutation(120)[:60]]
    assert find_moved_targets(sightings(places, seed, unseen)) == ()


def test_a_target_that_creeps_is_told_from_one_that_was_bumped():
    places = np.tile(PLACES, (VIEWS, 1, 1))
    places[:, 2] += np.linspace(0, 1, VIEWS)[:, None] * np.array([0.6, 0.0, 0.8])
    (found,) = find_moved_targets(sightings(places))
    others = np.delete(PLACES, 2, axis=0)
    change = np.linalg.norm(places[-1, 2] - others, axis=1) - np.linalg.norm(places[0, 2] - others, axis=1)
    assert found.target == "ball3" and found.drifts and "creeps" in found.describe("v007", "1 mm")
    assert found.distance == pytest.approx(np.abs(change).max(), abs=3 * SIGMA)
    (bumped,) = find_moved_targets(sightings(moved(2, VIEWS // 2, np.array([0.6, 0, 0.8]))))
    assert not bumped.drifts


def test_one_wrong_reading_is_left_to_the_search_for_outliers():
    places = np.tile(PLACES, (VIEWS, 1, 1))
    places[6, 1] += [0, 5.0, 0]
    assert find_moved_targets(sightings(places)) == ()
