"""Views whose targets bear each other's names, among points whose every place is known."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.observations.targets.outliers import find_mislabelled
from stitch.session.session import Sighting
from tests.screening.targets import PLACES, VIEWS, sightings

OFF = 3


def renamed(own, order):
    """Of one view target k bears the name of target order[k]."""
    target = own.target.copy()
    target[OFF] = np.array(order)[target[OFF]]
    return replace(own, target=target)


@pytest.mark.parametrize("order", [(1, 2, 3, 4, 0), (1, 0, 2, 3, 4), (4, 3, 2, 1, 0)])
@pytest.mark.parametrize("views", [5, VIEWS])
def test_names_that_are_mixed_up_are_put_right(order, views):
    (found,) = find_mislabelled(renamed(sightings(np.tile(PLACES, (views, 1, 1))), order))
    assert found.view == OFF
    right = {f"ball{name + 1}": f"ball{k + 1}" for k, name in enumerate(order) if name != k}
    assert dict(found.names) == right


def test_names_that_several_orders_explain_are_not_put_right():
    """Four corners of a square: turned round they are as far apart as before."""
    square = np.array([[0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100.0, 0]])
    (found,) = find_mislabelled(renamed(sightings(np.tile(square, (VIEWS, 1, 1))), (1, 0, 2, 3)))
    assert found.view == OFF and found.names == ()


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
    shown = np.flatnonzero(own.used[OFF])
    order = np.arange(count)
    order[shown] = rng.permutation(shown) if mixed_up else shown
    return renamed(own, order), order


@pytest.mark.parametrize("count", [30, 150])
def test_of_many_targets_those_of_a_view_are_put_right_too(count):
    sighted, order = many(count, True)
    (found,) = find_mislabelled(sighted)
    assert found.view == OFF
    assert dict(found.names) == {f"ball{name + 1}": f"ball{k + 1}" for k, name in enumerate(order) if name != k}
    assert f"and {len(found.names) - 24} more" in found.message("v003") or len(found.names) <= 24


@pytest.mark.parametrize("count", [30, 150])
def test_right_names_of_many_targets_are_left_alone(count):
    assert find_mislabelled(many(count, False)[0]) == ()


def with_corners(measured, order):
    """The cell with four targets on the part, whose names in one view are in another order."""
    corners = np.array([[0.0, 0, 0], [40, 0, 0], [0, 40, 0], [0, 0, 40]])
    corners = frames.transform(measured.T_reference_scanner[0], measured.clouds[0].points.mean(axis=0) + corners)
    session, rng, views = session_of(measured), np.random.default_rng(3), []
    for v, T in enumerate(measured.T_reference_scanner):
        seen = frames.transform(frames.inverse(T), corners) + 0.01 * rng.standard_normal(corners.shape)
        names = ("a", "b", "c", "d") if v != OFF else tuple("abcd"[k] for k in order)
        views.append(replace(session.views[v], sighting=Sighting(names, seen, np.full(4, 0.01))))
    return replace(session, views=tuple(views))


def test_beside_clouds_the_names_are_blamed_and_not_the_scan():
    """The labels held the scan in a wrong place, and another view was named."""
    measured = measured_blade(21, views=8, pixels=60)
    found = run(with_corners(measured, (1, 2, 3, 0)))
    assert found.left_out == () and "targets of view v003 bear each other's names" in found.doubts[0]
    assert [(o.view, o.target) for o in found.outliers] == [(OFF, None)]
    clean = run(with_corners(measured, (0, 1, 2, 3)))
    assert clean.doubts == () and clean.outliers == ()
    off = [np.linalg.norm(frames.log(frames.inverse(measured.T_mount) @ own.T_mount)[3:]) for own in (found, clean)]
    assert off[0] < 2 * off[1] + 0.02
