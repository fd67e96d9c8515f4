"""Targets that sit elsewhere from some view on, among points whose every place is known."""

import numpy as np
import pytest

from stitch import frames
from stitch.integrity.moved_targets import moved_targets
from stitch.measurement.sightings import Sightings

VIEWS, SIGMA = 14, 0.01
PLACES = np.array([[0, 0, 0], [120, 10, 0], [0, 90, 30], [80, 70, -20], [40, -60, 50.0]])


def sightings(places, seed=0, unseen=()):
    """What views from anywhere show of targets at places (V, K, 3)."""
    rng = np.random.default_rng(seed)
    views, count = places.shape[:2]
    turned = frames.exp(rng.normal(size=(views, 6)) * np.repeat([1.0, 100.0], 3))
    points = np.array([frames.transform(T, own) for T, own in zip(turned, places, strict=True)])
    target = np.tile(np.arange(count), (views, 1))
    for view, k in unseen:
        target[view, k] = -1
    points = points + SIGMA * rng.normal(size=points.shape)
    names = tuple(f"ball{k + 1}" for k in range(count))
    return Sightings(names, target, points, np.full(target.shape, SIGMA), target >= 0)


def moved(k, start, by, places=PLACES, views=VIEWS):
    out = np.tile(places, (views, 1, 1))
    out[start:, k] += by
    return out


@pytest.mark.parametrize(("k", "start"), [(0, 5), (3, 2), (4, 12)])
def test_a_target_that_moved_is_named_with_the_view_and_the_size(k, start):
    by = np.array([0.8, -1.2, 1.0])
    (found,) = moved_targets(sightings(moved(k, start, by)))
    others = np.delete(PLACES, k, axis=0)
    change = np.linalg.norm(PLACES[k] + by - others, axis=1) - np.linalg.norm(PLACES[k] - others, axis=1)
    assert (found.target, found.start) == (f"ball{k + 1}", start)
    assert found.distance == pytest.approx(np.abs(change).max(), abs=3 * SIGMA)


def test_two_that_moved_at_different_times_are_both_named():
    places = moved(1, 4, np.array([0, 0, 3.0]))
    places[9:, 2] += [2.0, 0, 0]
    assert sorted((m.target, m.start) for m in moved_targets(sightings(places))) == [("ball2", 4), ("ball3", 9)]


def test_among_three_targets_the_one_is_told_too():
    (found,) = moved_targets(sightings(moved(2, 6, np.array([1.0, 1.0, 0]), PLACES[:3])))
    assert (found.target, found.start) == ("ball3", 6)


def test_a_long_session_is_searched_ever_closer():
    (found,) = moved_targets(sightings(moved(0, 731, np.array([0.5, 0, 0.5]), views=1000)))
    assert (found.target, found.start) == ("ball1", 731)


@pytest.mark.parametrize("seed", range(20))
def test_targets_that_stay_are_not_accused(seed):
    rng = np.random.default_rng([seed, 1])
    unseen = [(v, int(rng.integers(5))) for v in range(VIEWS)]
    assert moved_targets(sightings(np.tile(PLACES, (VIEWS, 1, 1)), seed, unseen)) == ()


def test_what_grows_alike_is_no_target_that_moved():
    """A scanner that warms up lengthens all distances."""
    grown = PLACES * np.linspace(1, 1.002, VIEWS)[:, None, None]
    assert moved_targets(sightings(grown)) == ()


def test_one_wrong_reading_is_left_to_the_search_for_outliers():
    places = np.tile(PLACES, (VIEWS, 1, 1))
    places[6, 1] += [0, 5.0, 0]
    assert moved_targets(sightings(places)) == ()
