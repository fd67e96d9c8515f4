"""Boards in simulated scans whose corners are known: names, places, sigmas, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.board_scans import board_print, checkerboard_print, poses_before, scan_print
from stitch.errors import InputError
from stitch.plugins.intake.detection.boards import board_sightings, boards_in, lift_points, parse_board
from stitch.session.session import RangeImage

cv2 = pytest.importorskip("cv2")
CHARUCO = "charuco:8x6:12:9:DICT_4X4_50"
INNER = np.array([[c * 12.0, r * 12.0] for r in range(1, 6) for c in range(1, 8)])


@pytest.fixture(scope="module")
def charuco():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return board_print(cv2.aruco.CharucoBoard((8, 6), 12.0, 9.0, dictionary), 8, 6, 12.0)


@pytest.fixture(scope="module")
def scans(charuco):
    poses = poses_before(200, 3, np.array([48.0, 36.0]))
    return [scan_print(charuco, T, INNER, seed=i) for i, T in enumerate(poses)]


def sightings(scans, stated):
    board = parse_board(stated)
    views = [boards_in(RangeImage(s.points, s.grey), board, cv2) for s in scans]
    return board_sightings(views, board, 1.0, board.kind)[0]


def numbers(sighting):
    return [int(name.rsplit("-c", 1)[1]) for name in sighting.targets]


def test_corners_of_a_charuco_board_lie_where_they_are(scans):
    """A pixel is half a millimetre on the board: corners are good to a tenth of it, and their sigmas say how good."""
    ratios = []
    for scan, seen in zip(scans, sightings(scans, CHARUCO), strict=True):
        assert len(seen.targets) >= 32 and seen.targets[0].startswith("charuco-c")
        off = seen.points - scan.corners[numbers(seen)]
        assert np.sqrt(np.mean(off**2)) < 0.05
        ratios.append(np.mean((off / seen.sigma[:, None]) ** 2))
    assert 0.5 < np.sqrt(np.mean(ratios)) < 1.5


def test_rows_from_below_show_the_same_corners(scans):
    mirrored = replace(scans[0], points=scans[0].points[::-1], grey=scans[0].grey[::-1])
    upright, seen = (sightings([scan], CHARUCO)[0] for scan in (scans[0], mirrored))
    assert seen.targets == upright.targets
    assert np.abs(seen.points - upright.points).max() < 0.01


def test_a_checkerboard_turned_by_half_a_turn_keeps_its_names():
    inner = np.array([[c * 12.0, r * 12.0] for r in range(1, 6) for c in range(1, 9)])
    poses = poses_before(220, 2, np.array([54.0, 36.0]), seed=3)
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turn[:2, 3] = 108, 72
    seen = [scan_print(checkerboard_print(9, 6, 12.0), T, inner) for T in (poses[0], poses[1] @ turn)]
    for scan, found in zip(seen, sightings(seen, "checkerboard:9x6:12"), strict=True):
        assert numbers(found) == list(range(40))
        assert np.abs(found.points - scan.corners).max() < 0.15


def test_tags_are_named_by_their_number():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    tag = np.kron(cv2.aruco.generateImageMarker(dictionary, 7, 8), np.ones((40, 40))).astype(np.uint8)
    print_ = np.pad(tag, 160, constant_values=255)
    corners = np.array([[0.0, 0], [40, 0], [40, 40], [0, 40]])
    scan = scan_print(print_, poses_before(200, 1, np.array([20.0, 20.0]))[0], corners, margin=20.0)
    (seen,) = sightings([scan], "apriltag:36h11:40")
    assert seen.targets == tuple(f"apriltag-t007-{k}" for k in range(4))
    assert np.abs(seen.points - scan.corners).max() < 0.15


def test_noise_of_a_plane_averages_over_the_window():
    """A corner on a plane of noise s, seen through n pixels, has a height of sigma s/√n."""
    v, u = np.mgrid[:41, :41].astype(float)
    heights, told = [], []
    for seed in range(60):
        z = 100 + np.random.default_rng(seed).normal(0, 0.2, u.shape)
        points, sigma = lift_points(
            RangeImage(np.dstack([u, v, z]), z.astype(np.uint8)), np.array([[20.0, 20.0]]), np.array([8.0]), 0.0
        )
        heights.append(points[0, 2] - 100)
        told.append(sigma[0] * np.sqrt(3))
    expected = 0.2 / np.sqrt(17**2)
    assert np.std(heights) == pytest.approx(expected, rel=0.4)
    assert np.mean(told) == pytest.approx(expected, rel=0.15)


def test_another_surface_in_the_window_does_not_pull_the_corner():
    v, u = np.mgrid[:41, :41].astype(float)
    z = np.where(u > 24, 160.0, 100.0)
    points, _ = lift_points(
        RangeImage(np.dstack([u, v, z]), z.astype(np.uint8)), np.array([[20.3, 19.8]]), np.array([8.0]), 0.1
    )
    assert points[0] == pytest.approx([20.3, 19.8, 100.0], abs=1e-6)


def test_a_wrong_size_is_refused_with_the_one_found(scans):
    with pytest.raises(InputError, match=r"squares are 1[12]\.\d* mm in the scans, 20 mm are stated"):
        sightings(scans, "charuco:8x6:20:15:DICT_4X4_50")


@pytest.mark.parametrize(
    ("stated", "told"),
    [
        ("charuco:8x6:20", "is no board that is known"),
        ("charuco:8x6:9:12:DICT_4X4_50", "is no board that is known"),
        ("checkerboard:9x2:12", "is no board that is known"),
        ("apriltag:37h1:40", "is no board that is known"),
        ("board", "is no board that is known"),
    ],
)
def test_what_is_no_board_is_refused(stated, told):
    with pytest.raises(InputError, match=told):
        parse_board(stated)


@pytest.mark.parametrize(
    ("stated", "told"),
    [
        ("charuco:8x6:12:9:DICT_4X4_MANY", "no dictionary DICT_4X4_MANY"),
        ("charuco:20x20:12:9:DICT_4X4_50", "200 markers, the dictionary 50"),
        ("checkerboard:8x6:12", "look the same turned by half a turn"),
    ],
)
def test_what_cannot_be_seen_or_told_apart_is_refused(scans, stated, told):
    with pytest.raises(InputError, match=told):
        sightings(scans[:1], stated)
