"""Labelled points whose every place is known: targets that moved, names that are mixed up, and what is said of them."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.observations.targets.outliers import find_mislabelled
from stitch.screening.deep_check import deep_check
from stitch.screening.moved_targets import find_moved_targets
from stitch.screening.target_checks import target_warnings
from stitch.session.capture import sightings_of
from tests.screening.targets import PLACES, SIGMA, VIEWS, sightings, with_corners

MIXED_UP = 3
ARM_VIEWS, MOVED_FROM = 16, 9


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
    assert found.target == "ball3" and found.drifts
    assert found.distance == pytest.approx(np.abs(change).max(), abs=3 * SIGMA)
    (bumped,) = find_moved_targets(sightings(moved(2, VIEWS // 2, np.array([0.6, 0, 0.8]))))
    assert not bumped.drifts


def test_one_wrong_reading_is_left_to_the_search_for_outliers():
    places = np.tile(PLACES, (VIEWS, 1, 1))
    places[6, 1] += [0, 5.0, 0]
    assert find_moved_targets(sightings(places)) == ()


def renamed(own, order):
    """Of one view target k bears the name of target order[k]."""
    target = own.target.copy()
    target[MIXED_UP] = np.array(order)[target[MIXED_UP]]
    return replace(own, target=target)


@pytest.mark.parametrize("order", [(1, 2, 3, 4, 0), (1, 0, 2, 3, 4), (4, 3, 2, 1, 0)])
@pytest.mark.parametrize("views", [5, VIEWS])
def test_names_that_are_mixed_up_are_put_right(order, views):
    (found,) = find_mislabelled(renamed(sightings(np.tile(PLACES, (views, 1, 1))), order))
    assert found.view == MIXED_UP
    right = {f"ball{name + 1}": f"ball{k + 1}" for k, name in enumerate(order) if name != k}
    assert dict(found.names) == right


def test_names_that_several_orders_explain_are_not_put_right():
    """Four corners of a square: turned round they are as far apart as before."""
    square = np.array([[0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100.0, 0]])
    (found,) = find_mislabelled(renamed(sightings(np.tile(square, (VIEWS, 1, 1))), (1, 0, 2, 3)))
    assert found.view == MIXED_UP and found.names == ()


@pytest.mark.parametrize("seed", range(20))
def test_right_names_are_left_alone(seed):
    """Also where a target moved, where all grows, and where one reading is broken."""
    rng, places = np.random.default_rng([seed, 4]), np.tile(PLACES, (VIEWS, 1, 1))
    places[int(rng.integers(2, VIEWS - 2)) :, int(rng.integers(5))] += rng.normal(size=3)
    places *= np.linspace(1, 1.002, VIEWS)[:, None, None]
    places[int(rng.integers(VIEWS)), int(rng.integers(5))] += 5 * rng.normal(size=3)
    unseen = [(v, int(rng.integers(5))) for v in range(VIEWS)]
    assert find_mislabelled(sightings(places, seed, unseen)) == ()


def many(count, mixed_up):
    """Of `count` targets every view shows half; in one view those are in another order, if so."""
    rng = np.random.default_rng(count)
    places = np.tile(rng.uniform(-500, 500, (count, 3)), (VIEWS, 1, 1))
    unseen = [(v, int(k)) for v in range(VIEWS) for k in rng.permutation(count)[: count // 2]]
    own = sightings(places, 0, unseen)
    shown = np.flatnonzero(own.used[MIXED_UP])
    order = np.arange(count)
    order[shown] = rng.permutation(shown) if mixed_up else shown
    return renamed(own, order), order


@pytest.mark.parametrize("count", [30, 150])
def test_of_many_targets_those_of_a_view_are_put_right_too(count):
    sighted, order = many(count, True)
    (found,) = find_mislabelled(sighted)
    assert found.view == MIXED_UP
    assert dict(found.names) == {f"ball{name + 1}": f"ball{k + 1}" for k, name in enumerate(order) if name != k}
    assert f"and {len(found.names) - 24} more" in found.message("v003") or len(found.names) <= 24


@pytest.mark.parametrize("count", [30, 150])
def test_right_names_of_many_targets_are_left_alone(count):
    assert find_mislabelled(many(count, False)[0]) == ()


def test_beside_clouds_the_names_are_blamed_and_not_the_scan():
    """The labels held the scan in a wrong place, and another view was named."""
    measured = measured_blade(21, views=8, pixels=60)
    found = run(with_corners(measured, {MIXED_UP: "bcda"}))
    assert found.left_out == () and "targets of view v003 bear each other's names" in found.doubts[0]
    assert [(o.view, o.target) for o in found.outliers] == [(MIXED_UP, None)]
    clean = run(with_corners(measured))
    assert clean.doubts == () and clean.outliers == ()
    off = [np.linalg.norm(frames.log(frames.inverse(measured.T_mount) @ own.T_mount)[3:]) for own in (found, clean)]
    assert off[0] < 2 * off[1] + 0.02


def changed(session, change):
    """The session with what each view shows of targets changed."""
    views = [replace(view, sighting=change(v, view.sighting)) for v, view in enumerate(session.views)]
    return replace(session, views=tuple(views))


def test_a_good_session_has_none():
    assert deep_check(labelled_cell(0, views=ARM_VIEWS)[0]) == []


def test_a_target_that_moved_is_said_with_the_views_from_there_on():
    """Towards another one by 3 mm, whatever the pose."""
    session, *_ = labelled_cell(0, views=ARM_VIEWS)

    def change(v, shown):
        points = np.array(shown.points)
        if v >= MOVED_FROM:
            points[0] += 3.0 * (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
        return replace(shown, points=points)

    moved = changed(session, change)
    found = deep_check(moved)
    assert [(p.kind, p.views) for p in found] == [("displaced", tuple(session.names[MOVED_FROM:]))]
    assert target_warnings(moved, sightings_of(moved)) == (found[0].fix,)


def test_names_that_are_mixed_up_are_said_with_their_view():
    session, *_ = labelled_cell(0, views=ARM_VIEWS)

    def change(v, shown):
        return replace(shown, targets=tuple(np.roll(shown.targets, 1))) if v == MOVED_FROM else shown

    found = deep_check(changed(session, change))
    assert [(p.kind, p.views) for p in found] == [("exchanged", (session.names[MOVED_FROM],))]
