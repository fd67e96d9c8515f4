"""Clouds and poses of every kind become what a file of the same scan gives; what is none is refused in a sentence."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import RigidTransform, Rotation

from stitch.errors import InputError
from stitch.session.reading.arrays import cloud_of, poses_of, sighting_of
from stitch.session.reading.clouds import read_cloud
from stitch.session.session import Cloud
from tests.needs import needs_open3d

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(60, 3)) + np.array([0, 0, 500.0])
NORMALS = np.tile([0.0, 0.0, -1.0], (60, 1))
COLOURS = RNG.integers(0, 256, (60, 3), dtype=np.uint8)
INTENSITY = RNG.uniform(0, 1, 60)
ROTATIONS, SHIFTS = Rotation.random(4, RNG), RNG.normal(size=(4, 3))
POSES = np.tile(np.eye(4), (4, 1, 1))
POSES[:, :3, :3], POSES[:, :3, 3] = ROTATIONS.as_matrix(), SHIFTS


@pytest.fixture(scope="module")
def o3d():
    """Open3D, where it can be imported."""
    return needs_open3d()


def coloured(cloud):
    """Colours (N, 3) of a cloud, 0 … 255."""
    return np.column_stack([cloud.scalars[name] for name in ("red", "green", "blue")])


def test_an_array_is_taken_to_the_last_digit():
    assert np.array_equal(cloud_of(POINTS, "v").points, POINTS)
    single = POINTS.astype(np.float32)
    assert np.array_equal(cloud_of(single, "v", 1000.0).points, single.astype(float) * 1000.0)


def test_a_grid_of_pixels_leaves_out_those_that_measured_nothing():
    grid = POINTS.reshape(6, 10, 3).copy()
    grid[0, :4], grid[1, 0] = np.nan, 0.0
    assert np.array_equal(cloud_of(grid, "v").points, np.delete(POINTS, [0, 1, 2, 3, 10], axis=0))
    scan = {"points": grid, "intensity": INTENSITY.reshape(6, 10)}
    assert np.array_equal(cloud_of(scan, "v").scalars["intensity"], np.delete(INTENSITY, [0, 1, 2, 3, 10]))


def test_mappings_structured_arrays_and_clouds_keep_what_they_have():
    whole = cloud_of({"points": POINTS, "normals": NORMALS, "colors": COLOURS, "intensity": INTENSITY}, "v")
    assert np.array_equal(whole.normals, NORMALS) and np.array_equal(coloured(whole), COLOURS)
    assert np.array_equal(whole.scalars["intensity"], INTENSITY)
    again = cloud_of(whole, "v")
    assert np.array_equal(again.points, POINTS) and again.scalars.keys() == whole.scalars.keys()
    table = np.zeros(60, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("intensity", "f8")])
    table["x"], table["y"], table["z"], table["intensity"] = *POINTS.T, INTENSITY
    assert np.array_equal(cloud_of(table, "v").points, POINTS)
    assert np.array_equal(cloud_of(table, "v").scalars["intensity"], INTENSITY)


def test_a_point_cloud_of_trimesh_is_what_its_file_is(tmp_path):
    cloud = trimesh.PointCloud(POINTS, colors=COLOURS)
    found = cloud_of(cloud, "v")
    assert np.array_equal(coloured(found), COLOURS)
    cloud.export(tmp_path / "v.ply")
    read = read_cloud(tmp_path / "v.ply")
    assert np.allclose(read.points, found.points, atol=1e-4) and np.array_equal(coloured(read), coloured(found))
    assert not cloud_of(trimesh.PointCloud(POINTS), "v").scalars


def test_open3d_s_clouds_are_what_its_files_are(o3d, tmp_path):
    legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    legacy.normals = o3d.utility.Vector3dVector(NORMALS)
    legacy.colors = o3d.utility.Vector3dVector(COLOURS / 255)
    found = cloud_of(legacy, "v")
    o3d.io.write_point_cloud(str(tmp_path / "v.ply"), legacy)
    read = read_cloud(tmp_path / "v.ply")
    for one in (found, read):
        assert np.array_equal(one.points, POINTS) and np.array_equal(one.normals, NORMALS)
        assert np.array_equal(coloured(one), COLOURS)
    tensor = o3d.t.geometry.PointCloud.from_legacy(legacy)
    tensor.point["intensity"] = o3d.core.Tensor(INTENSITY[:, None].astype(np.float32))
    found = cloud_of(tensor, "v")
    assert np.allclose(found.points, POINTS, atol=1e-4) and np.array_equal(found.normals, NORMALS)
    assert np.array_equal(found.scalars["intensity"], INTENSITY.astype(np.float32))


def test_an_rgbd_image_is_lifted_as_open3d_lifts_it(o3d):
    depth = RNG.uniform(0.4, 0.6, (12, 16)).astype(np.float32)
    depth[0, :5] = 0
    colour = RNG.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    image = o3d.geometry.RGBDImage.create_from_color_and_depth(
        o3d.geometry.Image(colour), o3d.geometry.Image(depth), depth_scale=1.0, convert_rgb_to_intensity=False
    )
    lens = o3d.camera.PinholeCameraIntrinsic(16, 12, 20.0, 21.0, 7.5, 5.5)
    theirs = o3d.geometry.PointCloud.create_from_rgbd_image(image, lens)
    found = cloud_of((image, lens), "v")
    assert np.allclose(found.points, np.asarray(theirs.points), atol=1e-6)
    assert np.allclose(coloured(found), np.asarray(theirs.colors) * 255, atol=1e-4)
    with pytest.raises(InputError, match=r"to fix: pass \(image, intrinsics\)"):
        cloud_of(image, "v")


def test_a_depth_image_is_lifted_through_a_matrix_or_a_mapping():
    depth = np.full((4, 6), 500.0)
    depth[1, 2] = 0
    K = np.array([[100.0, 0, 2.5], [0, 100.0, 1.5], [0, 0, 1]])
    found = cloud_of((depth, K), "v").points
    assert len(found) == 23 and np.allclose(found[0], [-12.5, -7.5, 500])
    lens = {"fx": 100.0, "fy": 100.0, "cx": 2.5, "cy": 1.5}
    assert np.array_equal(cloud_of((depth, lens), "v").points, found)


def test_a_lens_that_distorts_lifts_pixels_to_points_that_opencv_projects_onto_them():
    cv2 = pytest.importorskip("cv2")
    coefficients = [0.1, -0.05, 0.002, -0.001, 0.01]
    lens = SimpleNamespace(fx=20.0, fy=21.0, ppx=7.5, ppy=5.5, width=16, height=12, coeffs=coefficients)
    lens.model = "distortion.brown_conrady"
    stated = {"fx": 20.0, "fy": 21.0, "cx": 7.5, "cy": 5.5, "distortion": coefficients}
    v, u = np.indices((12, 16))
    for given in (lens, stated):
        points = cloud_of((np.full((12, 16), 500.0), given), "v").points
        K = np.array([[20.0, 0, 7.5], [0, 21.0, 5.5], [0, 0, 1]])
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(coefficients))
        assert np.allclose(pixels[:, 0], np.column_stack([u.ravel(), v.ravel()]), atol=1e-3)
    lens.model = "distortion.inverse_brown_conrady"
    with pytest.raises(InputError, match="distorts by distortion.inverse_brown_conrady"):
        cloud_of((np.full((12, 16), 500.0), lens), "v")


@pytest.mark.parametrize(
    ("item", "says"),
    [
        (np.zeros((5, 2)), "v: an array of shape (5, 2)"),
        (np.zeros((5, 3)), "v: all 5 points are 0 0 0"),
        (np.array([[np.nan, 1, 2], [0, 1, 2]]), "v: 1 of 2 points are NaN or infinite"),
        ({"points": POINTS, "intensity": INTENSITY[:9]}, "v: intensity has 9 values for 60 points"),
        ({"points": POINTS, "normals": INTENSITY}, "v: normals of shape (60,)"),
        ({"intensity": INTENSITY}, "v: no column x, y, z"),
        ("scan.ply", "v: an array of shape ()"),
        ((np.zeros((4, 4)), np.eye(2)), "v: the intrinsics are no matrix (3, 3)"),
    ],
)
def test_what_is_no_cloud_is_refused(item, says):
    with pytest.raises(InputError) as refused:
        cloud_of(item, "v")
    assert str(refused.value).startswith(says) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "poses",
    [
        POSES,
        POSES.tolist(),
        list(POSES),
        RigidTransform.from_matrix(POSES),
        [RigidTransform.from_matrix(T) for T in POSES],
        (ROTATIONS, SHIFTS),
        [(R, t) for R, t in zip(ROTATIONS, SHIFTS, strict=True)],
        POSES.transpose(0, 2, 1),
    ],
    ids=["array", "nested", "list", "RigidTransform", "of them", "Rotation", "of those", "by columns"],
)
def test_poses_of_every_kind_are_one(poses):
    assert np.allclose(poses_of(poses, "poses"), POSES, atol=1e-14)


def test_matrices_are_taken_to_the_last_digit_where_they_are_rotations():
    assert np.array_equal(poses_of(POSES, "poses"), POSES)
    rounded = POSES.copy()
    rounded[:, :3, :3] = np.round(rounded[:, :3, :3], 4)
    R = poses_of(rounded, "poses")[:, :3, :3]
    assert np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12


@pytest.mark.parametrize(
    ("poses", "says"),
    [
        (POSES[:, :3], "poses: poses of shape (4, 3, 4)"),
        (POSES * [[1.1], [1.1], [1.1], [1]], "poses: pose "),
        (np.where(np.arange(4)[:, None, None] == 2, np.nan, POSES), "poses: pose 2 is not finite"),
        ((ROTATIONS, SHIFTS[:2]), "poses: (4,) rotations and translations of shape (2, 3)"),
        (["a", "b"], "poses: poses are not all matrices"),
        (POSES * np.array([-1.0, 1, 1, 1])[:, None], "poses: pose "),
    ],
)
def test_what_is_no_pose_is_refused(poses, says):
    with pytest.raises(InputError) as refused:
        poses_of(poses, "poses")
    assert str(refused.value).startswith(says) and "\n" not in str(refused.value)


def test_labelled_points_of_a_view_become_a_sighting():
    found = sighting_of({"ball1": (1, 2, 3), "ball2": [4, 5, 6]}, "v")
    assert found.targets == ("ball1", "ball2") and np.array_equal(found.points, [[1, 2, 3], [4, 5, 6]])
    assert np.isnan(found.sigma).all() and sighting_of({}, "v") is None and sighting_of(None, "v") is None
    with pytest.raises(InputError, match="not three finite numbers each"):
        sighting_of({"ball1": (1, 2)}, "v")


def test_a_thinned_cloud_gives_all_of_its_points():
    from stitch.session.session import Scanner
    from stitch.session.thinning import thin_cloud

    dense = RNG.normal(size=(500, 3)) + np.array([0, 0, 500.0])
    thin = thin_cloud("v", Cloud(dense), 100, Scanner(None, None, None, np.array([0, 0, 1.0])))
    assert len(thin.points) == 100 and np.array_equal(cloud_of(thin, "v").points, dense)
