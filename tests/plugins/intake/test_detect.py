"""`stitch detect` at the command line: sessions of organised clouds and of depth images, and what it refuses.

Balls on a table whose centres are known, and the sphere of a measured session: found, told apart, refused.

Boards in simulated scans whose corners are known: names, places, sigmas, and what is refused.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from data_synth.fixtures.ball_scans import Table, scan_table, table_poses
from data_synth.fixtures.board_scans import (
    Camera,
    board_print,
    checkerboard_print,
    poses_before,
    scan_print,
    write_board_session,
    write_pcd,
)
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.units import METRES
from stitch.plugins.intake.detection.balls import ViewBalls, ball_sightings, find_balls, label_balls
from stitch.plugins.intake.detection.boards import board_sightings, boards_in, lift_points, parse_board
from stitch.plugins.intake.detection.range_image import RangeImage
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.session_folder import load_session
from tests.command_line import ended

cv2 = pytest.importorskip("cv2")
BOARD = "charuco:8x6:12:9:DICT_4X4_50"
T_FLANGE_SCANNER = frames.make(Rotation.from_rotvec([0.3, -0.2, 0.8]).as_matrix(), np.array([40.0, -20, 90]))
T_BASE_BOARD = frames.make(Rotation.from_rotvec([3.0, 0.1, 0.2]).as_matrix(), np.array([700.0, 100, 50]))
# No two distances alike; the last ball is larger.
TABLE = Table(np.array([[-60.0, -40], [50, -45], [45, 40], [-35, 55], [0, 0]]), np.array([12.0, 12, 12, 12, 19]))
CHARUCO = "charuco:8x6:12:9:DICT_4X4_50"
INNER = np.array([[c * 12.0, r * 12.0] for r in range(1, 6) for c in range(1, 8)])


def charuco_print():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return board_print(cv2.aruco.CharucoBoard((8, 6), 12.0, 9.0, dictionary), 8, 6, 12.0)


@pytest.fixture(scope="module")
def cell():
    """Scans of a board from three poses, and the poses of the flange."""
    print_ = charuco_print()
    poses = poses_before(200, 3, np.array([48.0, 36.0]), tilt=0.5)
    scans = [scan_print(print_, T, INNER, seed=i) for i, T in enumerate(poses)]
    return scans, T_BASE_BOARD @ frames.inverse(poses) @ frames.inverse(T_FLANGE_SCANNER)


def scatter_in_base(session):
    """Rms distance (mm) of each corner, placed by the true poses, from its mean over the views."""
    placed: dict[str, list[np.ndarray]] = {}
    for view in session.views:
        for name, point in zip(view.sighting.targets, view.sighting.points, strict=True):
            T = view.T_base_flange @ frames.make(
                T_FLANGE_SCANNER[:3, :3], T_FLANGE_SCANNER[:3, 3] * 1e-3 / METRES[session.length_unit]
            )
            placed.setdefault(name, []).append(frames.transform(T, point[None])[0])
    off = [np.array(p) - np.mean(p, axis=0) for p in placed.values() if len(p) > 1]
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2))) * METRES[session.length_unit] * 1e3


def test_organised_clouds_with_colour(cell, tmp_path):
    folder = write_board_session(tmp_path / "s", *cell)
    out, err = ended("detect", folder, "--board", BOARD, "--json", "-o", folder / "points.csv")
    assert json.loads(out)["views"].keys() == {"v0", "v1", "v2"} and "stitch run" in err
    assert scatter_in_base(load_session(folder)) < 0.05
    table = (folder / "points.csv").read_text()
    assert "exists already" in ended("detect", folder, "--board", BOARD, "-o", folder / "points.csv", code=2).err
    assert ended("detect", folder, "--board", BOARD).out == table


def test_depth_images_beside_pictures(cell, tmp_path):
    """Depth in whole tenths of a millimetre, the session in metres: the same corners."""
    scans, poses = cell
    folder = write_board_session(tmp_path / "s", scans, frames.make(poses[:, :3, :3], poses[:, :3, 3] / 1000))
    table = (folder / "views.csv").read_text().replace("clouds/v", "clouds/depth_").replace(".pcd", ".png")
    (folder / "views.csv").write_text(table)
    told = (folder / "session.toml").read_text().replace('length_unit = "mm"', 'length_unit = "m"')
    (folder / "session.toml").write_text(told)
    K = Camera().matrix
    intrinsics = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "depth_scale": 10000}
    (folder / "clouds/intrinsics.json").write_text(json.dumps(intrinsics))
    for i, scan in enumerate(scans):
        depth = np.round(np.nan_to_num(scan.points[..., 2]) * 10).astype(np.uint16)
        assert cv2.imwrite(str(folder / f"clouds/depth_{i}.png"), depth)
        Image.fromarray(scan.grey).save(folder / f"clouds/color_{i}.png")
    ended("detect", folder, "--board", BOARD, "-o", folder / "points.csv")
    assert scatter_in_base(load_session(folder)) < 0.05


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        ((), 2, "state --board"),
        (("--board", "charuco"), 2, "is no board that is known"),
        (("--board", "charuco:8x6:24:18:DICT_4X4_50"), 2, "squares are 1"),
        (("--board", "apriltag:36h11:20"), 1, "no view shows"),
    ],
)
def test_what_cannot_be_found_ends_in_one_line(cell, tmp_path, arguments, code, told):
    scans, poses = cell
    folder = write_board_session(tmp_path / "s", scans[:1], poses[:1])
    out, err = ended("detect", folder, *arguments, code=code)
    assert told in err and not out and len(err.strip().splitlines()) == 1
    assert not (folder / "points.csv").exists()


def test_clouds_without_pixels_are_refused(session):
    assert "no scan is an image with brightness" in ended("detect", session, "--board", BOARD, code=2).err


@pytest.mark.slow
def test_a_flat_board_tells_how_poses_are_to_be_read(cell, tmp_path):
    """A plane slides on itself under any reading; its corners do not."""
    print_ = charuco_print()
    poses = poses_before(200, 6, np.array([48.0, 36.0]), seed=4, tilt=0.5)
    raw = tmp_path / "raw"
    raw.mkdir()
    small = Camera(240, 180, 300.0)
    for i, T in enumerate(poses):
        write_pcd(raw / f"scan{i}.pcd", scan_print(print_, T, INNER, seed=i, camera=small))
    T_base_flange = T_BASE_BOARD @ frames.inverse(poses) @ frames.inverse(T_FLANGE_SCANNER)
    angles = Rotation.from_matrix(T_base_flange[:, :3, :3]).as_euler("ZYX", degrees=True)
    rows = np.hstack([T_base_flange[:, :3, 3], angles])
    np.savetxt(raw / "poses.txt", rows, fmt="%.6f", delimiter=",")
    document = json.loads(ended("init", raw, "--board", BOARD, "--unit", "mm", "--yes", "--json").out)
    told = {guess["what"]: guess for guess in document["guesses"]}
    assert told["rotation"]["told"] and told["rotation"]["value"].startswith("zyx-intrinsic, degrees")
    assert told["pairing"]["told"] and told["targets"]["value"] == "35 in 6 of 6 clouds"
    session = load_session(raw)
    assert session.mount == "eye_in_hand" and scatter_in_base(session) < 0.1


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


@pytest.fixture(scope="module")
def charuco():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return board_print(cv2.aruco.CharucoBoard((8, 6), 12.0, 9.0, dictionary), 8, 6, 12.0)


@pytest.fixture(scope="module")
def board_scans(charuco):
    poses = poses_before(200, 3, np.array([48.0, 36.0]))
    return [scan_print(charuco, T, INNER, seed=i) for i, T in enumerate(poses)]


def sightings(board_scans, stated):
    board = parse_board(stated)
    views = [boards_in(RangeImage(s.points, s.grey), board, cv2) for s in board_scans]
    return board_sightings(views, board, 1.0, board.kind)[0]


def numbers(sighting):
    return [int(name.rsplit("-c", 1)[1]) for name in sighting.targets]


def test_corners_of_a_charuco_board_lie_where_they_are(board_scans):
    """A pixel is half a millimetre on the board: corners are good to a tenth of it, and their sigmas say how good."""
    ratios = []
    for scan, seen in zip(board_scans, sightings(board_scans, CHARUCO), strict=True):
        assert len(seen.targets) >= 32 and seen.targets[0].startswith("charuco-c")
        off = seen.points - scan.corners[numbers(seen)]
        assert np.sqrt(np.mean(off**2)) < 0.05
        ratios.append(np.mean((off / seen.sigma[:, None]) ** 2))
    assert 0.5 < np.sqrt(np.mean(ratios)) < 1.5


def test_rows_from_below_show_the_same_corners(board_scans):
    mirrored = replace(board_scans[0], points=board_scans[0].points[::-1], grey=board_scans[0].grey[::-1])
    upright, seen = (sightings([scan], CHARUCO)[0] for scan in (board_scans[0], mirrored))
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


def test_a_wrong_size_is_refused_with_the_one_found(board_scans):
    with pytest.raises(InputError, match=r"squares are 1[12]\.\d* mm in the scans, 20 mm are stated"):
        sightings(board_scans, "charuco:8x6:20:15:DICT_4X4_50")


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
def test_what_cannot_be_seen_or_told_apart_is_refused(board_scans, stated, told):
    with pytest.raises(InputError, match=told):
        sightings(board_scans[:1], stated)
