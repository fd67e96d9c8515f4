"""Depth images of OpenCV, NumPy and OpenEXR, with intrinsics as tools write them: points against the formula."""

import json

import numpy as np
import pytest
from PIL import Image

from stitch.errors import InputError
from stitch.plugins.intake.detection.range_image import read_range_image
from stitch.session.reading.clouds import read_cloud
from tests.needs import needs

cv2 = pytest.importorskip("cv2")
FX, FY, CX, CY = 310.0, 305.0, 15.5, 9.25
DEPTH = np.full((20, 30), 700, np.uint16) + np.arange(30, dtype=np.uint16)
DEPTH[4:6, 7:9] = 0
REALSENSE = {"fx": FX, "fy": FY, "ppx": CX, "ppy": CY, "width": 30, "height": 20, "coeffs": [0.0] * 5}
OPEN3D = {"width": 30, "height": 20, "intrinsic_matrix": [FX, 0, 0, 0, FY, 0, CX, CY, 1]}
ROS = f"""image_width: 30
image_height: 20
camera_name: depth
camera_matrix:
  rows: 3
  cols: 3
  data: [{FX}, 0.0, {CX}, 0.0, {FY}, {CY}, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.0, 0.0, 0.0, 0.0, 0.0]
"""
ZIVID = f"__version__: 1\nCameraIntrinsics:\n  CameraMatrix:\n    CX: {CX}\n    CY: {CY}\n    FX: {FX}\n    FY: {FY}\n  Distortion:\n    K1: 0\n    K2: 0\n    K3: 0\n    P1: 0\n    P2: 0\n"


def expected(depth):
    v, u = np.nonzero(depth)
    z = depth[v, u].astype(float)
    return np.column_stack([(u - CX) / FX * z, (v - CY) / FY * z, z])


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("intrinsics.json", json.dumps(REALSENSE)),
        ("camera_intrinsic.json", json.dumps(OPEN3D)),
        ("depth_camera_info.yaml", ROS),
        ("camera.yml", ZIVID),
        ("camera-intrinsics.txt", f"{FX} 0 {CX}\n0 {FY} {CY}\n0 0 1\n"),
        ("camera.json", json.dumps({"color": {**REALSENSE, "fx": 1.0}, "depth": REALSENSE})),
    ],
)
def test_intrinsics_as_tools_write_them(tmp_path, file, text):
    (tmp_path / file).write_text(text)
    cv2.imwrite(str(tmp_path / "depth_01.png"), DEPTH)
    assert np.allclose(read_cloud(tmp_path / "depth_01.png").points, expected(DEPTH))


def test_intrinsics_written_by_opencv(tmp_path):
    store = cv2.FileStorage(str(tmp_path / "calibration.yml"), cv2.FILE_STORAGE_WRITE)
    store.write("camera_matrix", np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]]))
    store.write("distortion_coefficients", np.array([[-0.2, 0.05, 0.001, -0.002, 0.01]]))
    store.release()
    cv2.imwrite(str(tmp_path / "depth.png"), DEPTH)
    points = read_cloud(tmp_path / "depth.png").points
    # Projected through the lens again, every point falls on its own pixel.
    K, lens = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]]), np.array([-0.2, 0.05, 0.001, -0.002, 0.01])
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, lens)[0][:, 0]
    assert np.abs(pixels - np.argwhere(DEPTH)[:, ::-1]).max() < 1e-3


@pytest.mark.parametrize("name", ["d.tif", "d.tiff", "d.exr", "d.npy"])
def test_floating_point_depth_is_in_metres(tmp_path, monkeypatch, name):
    metres = (DEPTH / 1000).astype(np.float32)
    (tmp_path / "intrinsics.json").write_text(json.dumps(REALSENSE))
    if name.endswith(".npy"):
        np.save(tmp_path / name, metres)
    else:
        if name.endswith(".exr"):
            needs("OpenEXR", "formats")
            monkeypatch.setenv("OPENCV_IO_ENABLE_OPENEXR", "1")
        assert cv2.imwrite(str(tmp_path / name), metres)
    assert np.allclose(read_cloud(tmp_path / name, 1000.0).points, expected(DEPTH), atol=1e-4)


@pytest.mark.parametrize("scale", [5000, 0.0002])
def test_a_stated_depth_scale_gives_metres(tmp_path, scale):
    (tmp_path / "intrinsics.json").write_text(json.dumps({**REALSENSE, "depth_scale": scale}))
    cv2.imwrite(str(tmp_path / "d.png"), DEPTH)
    assert np.allclose(read_cloud(tmp_path / "d.png").points, expected(DEPTH) / 5000)


@pytest.mark.parametrize(
    ("file", "text", "told"),
    [
        ("notes.json", "{}", "needs intrinsics"),
        ("intrinsics.json", "{", "needs intrinsics"),
        ("intrinsics.json", json.dumps({**REALSENSE, "width": 640, "height": 480}), "is of 640×480"),
        ("intrinsics.json", json.dumps({**REALSENSE, "fx": -1.0}), "no focal lengths"),
        ("intrinsics.json", json.dumps({**REALSENSE, "ppx": 320.0}), "outside its 30×20"),
        ("intrinsics.json", json.dumps({**REALSENSE, "depth_scale": 1}), "depth_scale 1 is neither"),
        ("intrinsics.json", json.dumps({**REALSENSE, "fx": "wide"}), "needs intrinsics"),
    ],
)
def test_intrinsics_that_do_not_serve_are_refused(tmp_path, file, text, told):
    (tmp_path / file).write_text(text)
    cv2.imwrite(str(tmp_path / "d.png"), DEPTH)
    with pytest.raises(InputError, match=told):
        read_cloud(tmp_path / "d.png")


def test_a_picture_is_no_depth(tmp_path):
    (tmp_path / "intrinsics.json").write_text(json.dumps(REALSENSE))
    cv2.imwrite(str(tmp_path / "d.png"), np.full((20, 30, 3), 90, np.uint8))
    with pytest.raises(InputError, match="are a picture, no depth"):
        read_cloud(tmp_path / "d.png")


def test_depth_and_picture_are_one_image(tmp_path):
    (tmp_path / "intrinsics.json").write_text(json.dumps(REALSENSE))
    picture = np.random.default_rng(0).integers(0, 255, (20, 30), np.uint8)
    for number in (1, 2):
        cv2.imwrite(str(tmp_path / f"depth_{number}.png"), DEPTH)
    cv2.imwrite(str(tmp_path / "color_2.png"), np.dstack([picture] * 3))
    assert read_range_image(tmp_path / "depth_1.png") is None
    image = read_range_image(tmp_path / "depth_2.png")
    assert (image.grey == picture).all()
    seen = np.isfinite(image.points[..., 2])
    assert (seen == (DEPTH > 0)).all() and np.allclose(image.points[seen], expected(DEPTH))


def test_a_picture_of_another_size_is_refused(tmp_path):
    (tmp_path / "intrinsics.json").write_text(json.dumps(REALSENSE))
    cv2.imwrite(str(tmp_path / "depth_1.png"), DEPTH)
    cv2.imwrite(str(tmp_path / "color_1.png"), np.full((40, 60, 3), 90, np.uint8))
    with pytest.raises(InputError, match="aligned to the depth"):
        read_range_image(tmp_path / "depth_1.png")


def test_heights_with_their_pitch_are_points_whose_rows_run_down(tmp_path):
    heights = np.array([[0, 1.5, 2.0], [-0.5, 0.25, 3.0]], np.float32)
    Image.fromarray(heights).save(tmp_path / "scan.tif")
    (tmp_path / "heights.json").write_text('{"pitch_x": 0.5, "pitch_y": 0.25, "z_scale": 2.0}')
    expected = [[0.5, 0, 3], [1, 0, 4], [0, -0.25, -1], [0.5, -0.25, 0.5], [1, -0.25, 6]]
    assert np.array_equal(read_cloud(tmp_path / "scan.tif").points, expected)


@pytest.mark.parametrize("names", [("X", "Y", "Z"), ("RGB",)])
def test_three_channels_of_an_exr_are_points(tmp_path, names):
    OpenEXR = needs("OpenEXR", "formats")
    points = np.random.default_rng(0).normal(size=(4, 5, 3)).astype(np.float32)
    points[1, 2] = 0.0  # nothing was measured there
    channels = {"RGB": points} if len(names) == 1 else dict(zip(names, np.moveaxis(points, 2, 0).copy(), strict=True))
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(tmp_path / "scan.exr"))
    assert np.array_equal(read_cloud(tmp_path / "scan.exr").points, points[points.any(axis=2)])
