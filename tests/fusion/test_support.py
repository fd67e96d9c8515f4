"""Junk in scans stays out of the cloud: worlds whose surface is known, with points that are on none."""

import numpy as np
import pytest

from stitch.fusion.fuse import place_scans
from stitch.fusion.look_through import range_images
from stitch.fusion.support import cell_numbers, find_support, number_groups
from stitch.numerics import frames
from stitch.session.scan import prepare_scan

NOISE, SPACING = 0.02, 1.0


def wave(x, y):
    """The surface, 500 before the scanner of the first view."""
    return 500 + 4 * np.sin(x / 15) + 3 * np.cos(y / 20)


def views_of(extra=None, seed=0, half=30.0):
    """Three scans of the wave from either side, with further points (N, 3) of the reference frame in the first one."""
    rng = np.random.default_rng(seed)
    scans, poses = [], []
    for turn in (-0.3, 0.0, 0.3):
        x, y = (g.ravel() for g in np.meshgrid(*[np.arange(-half, half, SPACING)] * 2))
        x, y = x + rng.uniform(-0.2, 0.2, x.shape), y + rng.uniform(-0.2, 0.2, x.shape)
        points = np.column_stack([x, y, wave(x, y) + NOISE * rng.standard_normal(len(x))])
        if extra is not None and not scans:
            points = np.vstack([points, extra])
        around = frames.make(frames.exp(np.array([0, turn, 0, 0, 0, 0]))[:3, :3], np.zeros(3))
        middle = frames.make(np.eye(3), np.array([0.0, 0.0, 500.0]))
        poses.append(middle @ around @ frames.inverse(middle))
        scans.append(prepare_scan(f"v{len(scans)}", frames.transform(frames.inverse(poses[-1]), points)))
    return scans, np.array(poses)


def kept_of(scans, poses):
    """Per point of the first view whether it is kept."""
    support = find_support(scans, poses, place_scans(scans, poses), SPACING)
    return support, support.kept[: len(scans[0].points)]


def test_clean_scans_lose_nothing():
    support, _ = kept_of(*views_of())
    assert support.kept.all()


def test_points_in_the_air_are_alone_and_surface_stays():
    rng = np.random.default_rng(1)
    junk = rng.uniform([-30, -30, 450], [30, 30, 550], (1000, 3))
    scans, poses = views_of(junk)
    support, kept = kept_of(scans, poses)
    surface = len(scans[0].points) - len(junk)
    off = np.abs(junk[:, 2] - wave(*junk[:, :2].T))
    # Slopes reach 0.3, so heights are distances to a twentieth.
    assert kept[surface:][off > 8 * NOISE].mean() < 0.01
    assert kept[:surface].mean() > 0.995
    assert support.alone.sum() > 900


def test_a_body_before_the_part_is_looked_past():
    """Dense and smooth in the view that it stands before; both others see the part behind it."""
    x, y = (g.ravel() for g in np.meshgrid(*[np.arange(-6, 6, SPACING / 2)] * 2))
    body = np.column_stack([x, y, 440 + 0.02 * x**2])
    scans, poses = views_of(body)
    support, kept = kept_of(scans, poses)
    surface = len(scans[0].points) - len(body)
    assert kept[surface:].mean() < 0.01 and support.looked_through.sum() > 0.9 * len(body)
    assert kept[:surface].all()


def test_a_surface_of_one_view_stays_where_no_view_looks_past_it():
    """A ledge beside the part, in the first view alone."""
    x, y = (g.ravel() for g in np.meshgrid(np.arange(60, 80, SPACING), np.arange(-20, 20, SPACING)))
    ledge = np.column_stack([x, y, np.full(len(x), 520.0)])
    _, kept = kept_of(*views_of(ledge))
    assert kept[-len(ledge) :].all()


def test_a_view_from_two_eyes_is_no_witness():
    """Layers behind each other that one eye cannot see: the view says nothing of what it looks past."""
    scans, _ = views_of(half=20.0)
    points = scans[0].points
    twice = prepare_scan("twice", np.vstack([points, points * 1.2]))
    images = range_images([twice, *scans[1:]], [np.ones(len(s.points), bool) for s in (twice, *scans[1:])], SPACING)
    assert images.trusted.tolist() == [False, True, True]


@pytest.fixture(scope="module")
def seen_from_three_sides():
    """Range images of clean scans, and places anywhere about the part."""
    scans, poses = views_of()
    images = range_images(scans, [np.ones(len(s.points), bool) for s in scans], SPACING)
    rng = np.random.default_rng(5)
    places, normals = rng.uniform([-60, -60, 300], [60, 60, 600], (5000, 3)), rng.standard_normal((5000, 3))
    return scans, poses, images, places, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("v", range(3))
def test_a_view_sees_past_what_lies_before_the_surface_within_its_field(seen_from_three_sides, v):
    """Where a ray first meets the surface, which is a formula, within what the scan shows of it."""
    scans, poses, images, places, normals = seen_from_three_sides
    found = images.views_through(scans[v], poses[v], v, places.T.copy(), normals, 3 * SPACING)
    eye = frames.transform(poses[v], scans[v].eye)
    along = np.linspace(1.0, 2.2, 300)[:, None, None] * (places - eye) + eye
    beyond = along[..., 2] > wave(along[..., 0], along[..., 1])
    meets = along[beyond.argmax(axis=0), np.arange(len(places))]
    within = beyond.any(axis=0) & (np.abs(meets[:, :2]) < 26).all(axis=1)
    before = within & (places[:, 2] < wave(*places[:, :2].T) - 20)
    assert before.sum() > 100 and (found[before] == 1).mean() > 0.99
    behind = places[:, 2] > wave(*places[:, :2].T) + 1
    assert not (found[behind] == 1).any()


@pytest.mark.parametrize("v", range(3))
def test_places_that_need_not_be_asked_are_none_that_a_view_speaks_of(seen_from_three_sides, v):
    scans, poses, images, places, normals = seen_from_three_sides
    found = images.views_through(scans[v], poses[v], v, places.T.copy(), normals, 3 * SPACING)
    told = images.may_concern(scans[v], poses[v], places, np.zeros(len(places)))
    assert told[found > 0].all() and 0 < told.sum() < len(places)
    balls = places.reshape(-1, 50, 3)
    centres = balls.mean(axis=1)
    radii = np.linalg.norm(balls - centres[:, None], axis=2).max(axis=1)
    assert images.may_concern(scans[v], poses[v], centres, radii)[(found.reshape(-1, 50) > 0).any(axis=1)].all()


@pytest.mark.parametrize("size", [0.3, 7.0])
def test_cells_and_groups_are_those_of_numpy(size):
    points = np.random.default_rng(2).normal(0, 20, (500, 3))
    cells = cell_numbers(points, size)
    expected = np.unique(np.floor(points / size), axis=0, return_inverse=True)[1]
    different, at = number_groups(cells)
    assert np.array_equal(at, np.ravel(expected)) and np.array_equal(different[at], cells)
