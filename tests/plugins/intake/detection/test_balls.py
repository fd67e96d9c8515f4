"""Balls on a table whose centres are known, and the sphere of a measured session: found, told apart, refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.ball_scans import Table, scan_table, table_poses
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.plugins.intake.detection.balls import ViewBalls, ball_sightings, find_balls, label_balls
from stitch.session.reading.clouds import read_cloud

# No two distances alike; the last ball is larger.
TABLE = Table(np.array([[-60.0, -40], [50, -45], [45, 40], [-35, 55], [0, 0]]), np.array([12.0, 12, 12, 12, 19]))


@pytest.fixture(scope="module")
def scans():
    poses = table_poses(2)
    return poses, [scan_table(TABLE, T, seed=i) for i, T in enumerate(poses)]


def test_balls_of_any_radius_have_one_name_in_every_view(scans):
    poses, clouds = scans
    sightings, notes = ball_sightings(clouds, [T[:3, :3].T for T in poses], [], 1.0)
    assert not notes
    names: dict[str, int] = {}
    for T, seen in zip(poses, sightings, strict=True):
        true = frames.transform(T, TABLE.centres)
        assert sorted(seen.targets) == [f"ball{i}" for i in range(1, 6)]
        for name, point in zip(seen.targets, seen.points, strict=True):
            off = np.linalg.norm(true - point, axis=1)
            # Noise of 0.03 mm over more than a hundred points.
            assert off.min() < 0.03
            assert names.setdefault(name, int(np.argmin(off))) == np.argmin(off)
    # Numbers run by radius.
    assert names["ball5"] == 4


def test_what_is_no_ball_is_none():
    rng = np.random.default_rng(0)
    u = np.stack(np.meshgrid(np.linspace(-60, 60, 80), np.linspace(-60, 60, 80)), axis=2).reshape(-1, 2)
    lying = np.column_stack([u, 300 - np.sqrt(np.maximum(70.0**2 - u[:, 0] ** 2, 0))])
    wavy = np.column_stack([u, 300 + 6 * np.sin(u[:, 0] / 9) * np.cos(u[:, 1] / 13)])
    edge = np.column_stack([u, 300 + 0.6 * np.abs(u[:, 0])])
    for surface in (lying, wavy, edge):
        assert not find_balls(surface + rng.normal(0, 0.03, surface.shape) * [0, 0, 1])


def test_a_wrong_radius_is_refused_with_the_one_found(scans):
    poses, clouds = scans
    with pytest.raises(InputError, match=r"no ball of this radius; balls of 1[12]\.\d\d mm are seen in 1 view;"):
        ball_sightings(clouds[:1], [poses[0][:3, :3].T], [16.0], 1.0)


def test_only_balls_of_the_radius_stated_count(scans):
    poses, clouds = scans
    (seen,), _ = ball_sightings(clouds[:1], [poses[0][:3, :3].T], [19.0], 1.0)
    assert seen.targets == ("ball1",)
    assert np.linalg.norm(seen.points[0] - frames.transform(poses[0], TABLE.centres[4:])[0]) < 0.03


def test_the_sphere_of_a_measured_session(reghec):
    """A calibration sphere scanned by an industrial camera: one radius in every view, to a hundredth of a millimetre."""
    files = sorted((reghec("sphere") / "clouds").glob("*.pcd"))[:2]
    found = [find_balls(read_cloud(file, 1000.0).points) for file in files]
    assert [len(balls) for balls in found] == [1, 1]
    radii = [balls[0].radius for balls in found]
    assert np.std(radii) < 0.05
    # Algebraic least squares of all points, for comparison.
    for file, balls in zip(files, found, strict=True):
        P = read_cloud(file, 1000.0).points
        x = np.linalg.lstsq(np.column_stack([2 * P, np.ones(len(P))]), (P**2).sum(axis=1), rcond=None)[0]
        assert balls[0].centre == pytest.approx(x[:3], abs=0.05)


def view(centres, turn, radii=None, order=None):
    """Balls seen by a scanner that sits on the flange: it has turned as the flange has."""
    R = Rotation.from_rotvec(turn).as_matrix()
    order = range(len(centres)) if order is None else order
    picked = centres[list(order)]
    radii = np.full(len(picked), 10.0) if radii is None else radii[list(order)]
    return ViewBalls(picked @ R + [1.0, 2, 3], np.full(len(picked), 0.01), radii, R)


SQUARE = np.array([[0.0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 0]])
SCALENE = np.array([[0.0, 0, 0], [100, 0, 0], [40, 70, 0], [60, 30, 50]])


def test_names_follow_the_distances_whatever_the_order():
    views = [
        view(SCALENE, [0, 0, 0]),
        view(SCALENE, [0.3, 0.2, 2.0], order=[2, 0, 3]),
        view(SCALENE, [0.1, 0, 1], order=[3, 1, 0, 2]),
    ]
    assert label_balls(views) == [[0, 1, 2, 3], [2, 0, 3], [3, 1, 0, 2]]


def test_a_ball_that_only_a_later_view_shows_gets_a_name():
    views = [view(SCALENE[:3], [0, 0, 0]), view(SCALENE[:3], [0, 0, 1]), view(SCALENE, [0.3, 0, 0], order=[3, 2, 1, 0])]
    first, second, third = label_balls(views)
    assert third == [0, 1, 2, 3] and first == second == [3, 2, 1]


def test_symmetry_is_told_apart_by_how_far_the_arm_has_turned():
    views = [view(SQUARE, [0, 0, 0]), view(SQUARE, [0, 0, 0.5]), view(SQUARE, [0.4, 0, 1.2], order=[1, 2, 3, 0])]
    assert label_balls(views) == [[0, 1, 2, 3], [0, 1, 2, 3], [1, 2, 3, 0]]


def test_two_balls_of_one_radius_have_no_names_and_two_of_different_radii_do():
    pair = SQUARE[:2]
    assert label_balls([view(pair, [0, 0, 0]), view(pair, [0, 0, 1])]) == [[None, None]] * 2
    radii = np.array([10.0, 15])
    assert label_balls([view(pair, [0, 0, 0], radii), view(pair, [0, 0, 1], radii, [1, 0])]) == [[0, 1], [1, 0]]


def test_a_grid_of_many_balls_ends_without_names_or_with_the_right_ones():
    grid = np.array([[30.0 * x, 30.0 * y, 0] for x in range(6) for y in range(6)])
    views = [view(grid, [0, 0, 0]), view(grid, [0.3, 0.1, 0.7], order=range(0, 36, 2))]
    first, second = label_balls(views)
    assert first == list(range(36)) and second in (list(range(0, 36, 2)), [None] * 18)
