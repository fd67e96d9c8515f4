"""Scans in formats of other trades: samples typed after the formats' own descriptions, and files of other libraries."""

import base64
import json
import struct

import numpy as np
import pytest

from stitch.errors import InputError
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.range_image import read_range_image
from tests.needs import needs

CORNERS = np.array([[0.0, 0, 100], [10, 0, 100], [0, 10, 100], [10, 10, 100]])
FACES = [(0, 1, 2), (1, 3, 2)]
STL = (
    "solid s\n"
    + "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in CORNERS[list(face)])
        + "endloop\nendfacet\n"
        for face in FACES
    )
    + "endsolid s\n"
)
OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "f 1 2 3\nf 2 4 3\n"
OFF = "OFF\n4 2 0\n" + "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS) + "3 0 1 2\n3 1 3 2\n"
PTX = (
    "2\n2\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    + "0 0 100 0.5\n10 0 100 0.25\n0 0 0 0\n10 10 100 1\n"
)
PCD = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA ascii\n"


def gltf():
    """A triangle mesh with its buffer inside, after the specification of glTF 2.0."""
    data = CORNERS.astype("<f4").tobytes() + struct.pack("<6H", *(i for face in FACES for i in face))
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 12}]
    return json.dumps({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": 60, "uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode()}],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 100], "max": [10, 10, 100]},
            {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
    })  # fmt: skip


def glb():
    """The same as one binary file: a header, the JSON padded with blanks, no further chunk."""
    text = gltf().encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sII", b"glTF", 2, 20 + len(text)) + struct.pack("<I4s", len(text), b"JSON") + text


def as_sets(points):
    return {tuple(np.round(p, 4)) for p in points}


@pytest.mark.parametrize(
    ("name", "content"),
    [("s.stl", STL), ("s.obj", OBJ), ("s.off", OFF), ("s.gltf", gltf()), ("s.glb", glb())],
)
def test_meshes_are_their_vertices_each_once_with_normals(tmp_path, name, content):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    cloud = read_cloud(tmp_path / name)
    assert len(cloud.points) == 4 and as_sets(cloud.points) == as_sets(CORNERS)
    assert np.allclose(cloud.normals, [0, 0, 1])


def test_ptx_leaves_out_what_was_not_measured(tmp_path):
    (tmp_path / "s.ptx").write_text(PTX)
    cloud = read_cloud(tmp_path / "s.ptx")
    assert cloud.points.tolist() == CORNERS[[0, 1, 3]].tolist() and cloud.scalars["intensity"].tolist() == [
        0.5,
        0.25,
        1,
    ]


def test_an_image_of_points_has_empty_pixels(tmp_path):
    image = CORNERS.reshape(2, 2, 3).copy()
    image[0, 1] = np.nan
    np.save(tmp_path / "s.npy", image)
    assert read_cloud(tmp_path / "s.npy").points.tolist() == CORNERS[[0, 2, 3]].tolist()
    rows = "0 0 100\nnan nan nan\n0 10 100\n10 10 100\n"
    (tmp_path / "s.pcd").write_text(PCD + rows)
    assert read_cloud(tmp_path / "s.pcd").points.tolist() == CORNERS[[0, 2, 3]].tolist()
    head = "ply\nformat ascii 1.0\nobj_info num_cols 2\nobj_info num_rows 2\nelement vertex 4\n"
    (tmp_path / "s.ply").write_text(head + "".join(f"property float {a}\n" for a in "xyz") + "end_header\n" + rows)
    assert read_cloud(tmp_path / "s.ply").points.tolist() == CORNERS[[0, 2, 3]].tolist()


@pytest.mark.parametrize("row", ["1 nan 3", "inf 0 0"])
def test_half_a_pixel_is_refused(tmp_path, row):
    (tmp_path / "s.pcd").write_text(PCD + f"0 0 100\n{row}\n0 10 100\n10 10 100\n")
    with pytest.raises(InputError, match="NaN or infinite"):
        read_cloud(tmp_path / "s.pcd")


def test_nan_in_a_list_of_points_is_refused(tmp_path):
    (tmp_path / "s.pcd").write_text(
        PCD.replace("WIDTH 2\nHEIGHT 2", "WIDTH 4\nHEIGHT 1") + "0 0 1\nnan nan nan\n0 1 1\n1 1 1\n"
    )
    with pytest.raises(InputError, match="NaN or infinite"):
        read_cloud(tmp_path / "s.pcd")


def test_las_and_e57_by_their_packages(tmp_path):
    laspy, pye57 = needs("laspy", "formats"), needs("pye57", "formats")
    las = laspy.create(point_format=0)
    las.header.scales = [1e-4] * 3
    las.x, las.y, las.z = CORNERS.T
    las.write(str(tmp_path / "s.las"))
    assert np.allclose(read_cloud(tmp_path / "s.las").points, CORNERS, atol=1e-4)
    with pye57.E57(str(tmp_path / "s.e57"), mode="w") as file:
        columns = {f"cartesian{axis}": column.copy() for axis, column in zip("XYZ", CORNERS.T, strict=True)}
        file.write_scan_raw(columns, rotation=np.array([0.8, 0, 0.6, 0]), translation=np.array([1.0, 2, 3]))
    assert np.allclose(read_cloud(tmp_path / "s.e57").points, CORNERS)


def zdf(path, points, **more):
    """A file in the layout that Zivid's sample programs read."""
    h5py = needs("h5py", "formats")
    with h5py.File(path, "w") as file:
        for name, values in {"pointcloud": points, **more}.items():
            file[f"data/{name}"] = values
    return path


def test_zdf_is_an_image_of_points(tmp_path):
    """Pixels that measured nothing are no points; colours make it a range image."""
    points = np.full((3, 4, 3), np.nan, np.float32)
    points[1, :] = CORNERS[:4]
    colours = np.zeros((3, 4, 4), np.uint8)
    colours[1, 2] = (90, 120, 150, 255)
    path = zdf(tmp_path / "s.zdf", points, rgba_image=colours)
    cloud = read_cloud(path, 1e-3)
    assert np.allclose(cloud.points, CORNERS[:4] * 1e-3) and cloud.scalars["blue"].tolist() == [0, 0, 150, 0]
    image = read_range_image(path)
    assert image.points.shape == (3, 4, 3) and np.isnan(image.points[0]).all()
    assert np.unravel_index(image.grey.argmax(), image.grey.shape) == (1, 2)


def test_zdf_of_another_layout_says_how_to_get_in(tmp_path):
    with pytest.raises(InputError, match=r"no data/pointcloud .* save it as PLY"):
        read_cloud(zdf(tmp_path / "s.zdf", np.zeros((4, 3))))


@pytest.mark.parametrize(("name", "package"), [("s.las", "laspy"), ("s.e57", "pye57"), ("s.zdf", "h5py")])
def test_a_package_that_is_not_there_is_named(tmp_path, monkeypatch, name, package):
    (tmp_path / name).write_bytes(b"x" * 100)
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(InputError, match=f"needs the package {package}"):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "text"),
    [("s.stl", "solid\n"), ("s.obj", "# nothing\n"), ("s.ptx", "5\n5\n"), ("s.gltf", "{}"), ("s.npy", "x")],
)
def test_broken_files_end_in_one_line(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=name):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize("row", ["{} {} {} 128\n", "{}; {}; {}\n"])
def test_commas_before_the_decimals(tmp_path, row):
    rows = "".join(row.format(*(f"{value + 0.25:.2f}".replace(".", ",") for value in corner)) for corner in CORNERS)
    (tmp_path / "c.txt").write_text(f"{len(CORNERS)}\n{rows}", encoding="utf-8")
    np.testing.assert_allclose(read_cloud(tmp_path / "c.txt").points, CORNERS + 0.25)
