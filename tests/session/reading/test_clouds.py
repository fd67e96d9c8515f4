"""Clouds of other libraries are read to the same numbers, and samples typed after the formats' own descriptions.

Poses in the headers of scans: files of pye57, and samples typed after the formats' descriptions.
"""

import base64
import json
import struct
from types import SimpleNamespace

import imagecodecs
import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from stitch.errors import InputError
from stitch.plugins.intake.detection.range_image import read_range_image
from stitch.plugins.intake.first_session import first_session
from stitch.plugins.intake.scan_headers import poses_in_scans, times_in_scans
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.session.reading.clouds import cloud_of_columns, read_cloud
from tests.needs import needs

POINTS = np.random.default_rng(0).normal(size=(500, 3)) * 100
FOUR_POINTS = "0 0 100 0.5\n10 0 100 0.25\n0 10 100 1\n10 10 100 1\n"
# A quarter turn about z: the scanner's x lies along y of what it stands in.
TURNED = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
AS_IT_IS = np.eye(4)


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
def test_ply_files_keep_points_normals_and_scalars(tmp_path, text, order):
    vertex = np.empty(
        500, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("nx", "f4"), ("ny", "f4"), ("nz", "f4"), ("intensity", "u2")]
    )
    for i, axis in enumerate("xyz"):
        vertex[axis] = POINTS[:, i]
        vertex["n" + axis] = i == 2
    vertex["intensity"] = np.arange(500)
    PlyData([PlyElement.describe(vertex, "vertex")], text=text, byte_order=order).write(str(tmp_path / "c.ply"))
    cloud = read_cloud(tmp_path / "c.ply", 0.001)
    assert np.allclose(cloud.points, POINTS / 1000, atol=1e-9)
    assert np.allclose(cloud.normals, [0, 0, 1])
    assert np.array_equal(cloud.scalars["intensity"], np.arange(500))


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_in_each_encoding_is_read_to_the_same_numbers(tmp_path, encoding):
    """Packed by LibLZF itself; repeated rows give it something to pack."""
    points = np.vstack([POINTS, np.repeat(POINTS[:5], 60, axis=0)]).astype("<f4")
    if encoding == "ascii":
        body = "\n".join(" ".join(map(repr, row)) for row in points.tolist()).encode()
    elif encoding == "binary":
        body = points.tobytes()
    else:
        fields = points.T.tobytes()
        packed = imagecodecs.lzf_encode(fields)
        assert len(packed) < len(fields)
        body = struct.pack("<II", len(packed), len(fields)) + packed
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {encoding}\n"
    )
    (tmp_path / "c.pcd").write_bytes(header.encode() + body)
    assert np.array_equal(read_cloud(tmp_path / "c.pcd").points, points)


def test_pcd_with_padding_vectors_and_odd_names(tmp_path):
    layout = np.dtype([("Coord._Z", "<f4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f8"), ("_", "u1", 4), ("t", "<u4")])
    table = np.zeros(500, layout)
    for i, axis in enumerate("xyz"):
        table[axis] = POINTS[:, i]
    table["_"], table["t"] = 255, np.arange(500)
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS Coord._Z x y z _ t\nSIZE 4 4 4 8 1 4\nTYPE F F F F U U\n"
        "COUNT 1 1 1 1 4 1\nWIDTH 500\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 500\nDATA binary\n"
    )
    (tmp_path / "c.pcd").write_bytes(header.encode() + table.tobytes())
    cloud = read_cloud(tmp_path / "c.pcd")
    assert np.allclose(cloud.points, POINTS, atol=1e-4)
    assert set(cloud.scalars) == {"Coord._Z", "t"}
    (tmp_path / "c.pcd").write_bytes(header.encode() + table.tobytes()[:-40])
    with pytest.raises(InputError, match="500 points announced"):
        read_cloud(tmp_path / "c.pcd")


def test_a_real_pcd_with_padding_is_read(reghec):
    for name in ("david", "sphere"):
        path = reghec(name) / "clouds" / "view1.pcd"
        header, _, body = path.read_bytes().partition(b"DATA binary\n")
        assert b"FIELDS x y z _\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 4\n" in header
        table = np.frombuffer(body, [("place", "<f4", 3), ("_", "u1", 4)])
        assert np.array_equal(read_cloud(path).points, table["place"])


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        (".xyz", "1 2 3 9\n4 5 6 8\n"),
        (".csv", "x,y,z,intensity\n1,2,3,9\n4,5,6,8\n"),
        (".txt", "# c\n1;2;3;9\n4;5;6;8\n"),
        (".xyz", "# taken at noon\n# X Y Z intensity\n1 2 3 9\n4 5 6 8\n"),
    ],
)
def test_text_clouds_keep_points_and_scalars(tmp_path, suffix, text):
    path = tmp_path / f"c{suffix}"
    path.write_text(text)
    cloud = read_cloud(path)
    assert np.array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    (name,) = cloud.scalars
    assert np.array_equal(cloud.scalars[name], [9, 8])
    assert name == ("intensity" if "intensity" in text else "scalar_0")


def test_points_at_the_scanner_itself_are_no_measurement(tmp_path):
    """Structured exports keep a place for every pixel; scalars and normals stay with their points."""
    path = tmp_path / "c.csv"
    path.write_text("x,y,z,nx,ny,nz,intensity\n0,0,0,0,0,0,0\n1,0,3,0,0,1,9\n-0.0,0,0,0,0,0,0\n0,0,6,0,1,0,8\n")
    cloud = read_cloud(path)
    assert np.array_equal(cloud.points, [[1, 0, 3], [0, 0, 6]])
    assert np.array_equal(cloud.normals, [[0, 0, 1], [0, 1, 0]])
    assert np.array_equal(cloud.scalars["intensity"], [9, 8])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [("c.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\nend_header\n", "cannot be read"),
     ("c.ply", b"", "the file is empty; export it again"), ("c.ply", b"\x8f\xb7\x02\x9a" * 50, "is not a PLY file"),
     ("c.pcd", b"not a cloud", "no DATA line"), ("c.fls", b"", "unknown cloud format"), ("c.csv", b"a,b\n1,2\n", "no column"),
     ("c.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 9\nDATA binary_compressed\n" + struct.pack("<II", 50, 108), "cut short")],
)  # fmt: skip
def test_broken_files_say_so(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize(
    ("count", "packed", "size", "told"),
    [
        (1, b"\x0b" + bytes(12), 12, "nothing was measured"),
        # Four bytes, then eight more from four back: a pattern that reads what it writes.
        (1, b"\x03\0\0\x80\x3f\xc0\x03", 12, None),
        (1, b"\xff\xff\xff\xff", 12, "do not give its 1 points"),
        (1, b"\x20\x00abc", 12, "error in compressed data"),
        (1, b"\x02abc", 12, "do not give its 1 points"),
        (9, b"\x02abc", 12, "cut short"),
        (0, b"", 0, "no points"),
    ],
)
def test_a_compressed_pcd_of_few_bytes_is_read_or_refused(tmp_path, count, packed, size, told):
    header = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS {count}\nDATA binary_compressed\n"
    (tmp_path / "c.pcd").write_bytes(header.encode() + struct.pack("<II", len(packed), size) + packed)
    if told is None:
        assert read_cloud(tmp_path / "c.pcd").points.tolist() == [[1, 1, 1]]
        return
    with pytest.raises(InputError, match=told):
        read_cloud(tmp_path / "c.pcd")


@pytest.mark.parametrize("name", ["s.ply", "s.pcd", "s.xyz", "s.stl", "s.e57", "s.png"])
def test_what_git_lfs_has_not_fetched_says_how_to_fetch_it(name, tmp_path):
    """The pointer as the specification of Git LFS has it."""
    oid = "4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393"
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{oid}\nsize 12345\n"
    (tmp_path / name).write_text(pointer)
    with pytest.raises(InputError, match="git lfs pull"):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize(
    "code", [(-99999, -99999, -99999), (np.nan, np.nan, -32.768), (0.0, 0.0, -32.768), (9999, 0, 0)]
)
@pytest.mark.parametrize("times", [3, 100, 9000])
def test_a_code_for_nothing_measured_is_no_point(code, times):
    """A few of the pixels or most of them; what was measured stays, in its order."""
    points = np.random.default_rng(0).uniform([-0.1, -0.1, 0.4], [0.1, 0.1, 0.5], (1000, 3))
    at = np.sort(np.random.default_rng(1).integers(0, 1000, times))
    code = np.nan_to_num(code, nan=0.05)
    columns = dict(zip("xyz", np.insert(points, at, code, axis=0).T, strict=True))
    columns["intensity"] = np.insert(points[:, 2], at, 0.0)
    cloud = cloud_of_columns("scan", columns)
    assert np.array_equal(cloud.points, points) and np.array_equal(cloud.scalars["intensity"], points[:, 2])
    assert cloud.coded == times and set(cloud.codes) <= set(code)


def test_what_is_flat_or_stepped_or_quantised_is_no_code():
    x, y = (g.ravel() for g in np.meshgrid(*[np.arange(40) * 0.5] * 2))
    for z in (np.full(1600, 500.0), np.where(x > 15, 500.0, 100.0), np.round(300 + 0.3 * x)):
        cloud = cloud_of_columns("scan", {"x": x.copy(), "y": y.copy(), "z": z.copy()})
        assert np.array_equal(cloud.points[:, 2], z)


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
def test_a_text_cloud_with_decimal_commas_is_read(tmp_path, row):
    rows = "".join(row.format(*(f"{value + 0.25:.2f}".replace(".", ",") for value in corner)) for corner in CORNERS)
    (tmp_path / "c.txt").write_text(f"{len(CORNERS)}\n{rows}", encoding="utf-8")
    np.testing.assert_allclose(read_cloud(tmp_path / "c.txt").points, CORNERS + 0.25)


def test_records_of_kitti_are_points_and_brightness(tmp_path):
    np.column_stack([POINTS, np.ones(500)]).astype("<f4").tofile(tmp_path / "000000.bin")
    cloud = read_cloud(tmp_path / "000000.bin")
    assert np.allclose(cloud.points, POINTS, atol=1e-4) and (cloud.scalars["intensity"] == 1).all()


@pytest.mark.parametrize("head", ["", "500\n", "25 x 20\n"])
def test_the_left_handed_axes_of_3dtk_become_right_handed(tmp_path, head):
    rows = "\n".join(f"{x:.9f} {y:.9f} {z:.9f} 17" for x, y, z in POINTS * [1, 1, -1])
    (tmp_path / "scan000.3d").write_text(head + rows)
    assert np.allclose(read_cloud(tmp_path / "scan000.3d").points, POINTS, atol=1e-8)


def test_lines_of_a_ply_header_that_other_programs_add_are_passed_over(tmp_path):
    (tmp_path / "c.ply").write_text(
        "ply\nformat ascii 1.0\nTextureFile scan.png\nelement vertex 2\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n1 2 3\n4 5 6\n"
    )
    assert np.array_equal(read_cloud(tmp_path / "c.ply").points, [[1, 2, 3], [4, 5, 6]])


GOCATOR = "Info\nCSV Version,Sensor Count\n2,1\nEnd\nDeviceInfo\nID,Model\n13434,2330\nEnd\n"


@pytest.mark.parametrize(
    "section",
    [
        "Part\nFrame,Source\n0,0\nY,-1.5,0.5\n10,,7.25\n12,7.5,8\nEnd\n",
        "Surface\nFrame,Source\n0,0\nFrame,Y,Axis,-1.5,0.5\n1,10,Z,,7.25\n1,10,I,9,9\n1,12,Z,7.5,8\nEnd\n",
        "SurfacePointCloud\nFrame,Source\n0,0\nx,y,z\n0.5,10,7.25,-1.5,12,7.5\n0.5,12,8,,,\nEnd\n",
    ],
)
def test_surfaces_of_gocator_in_each_of_its_sections(tmp_path, section):
    (tmp_path / "scan.csv").write_text(GOCATOR + section)
    assert np.array_equal(read_cloud(tmp_path / "scan.csv").points, [[0.5, 10, 7.25], [-1.5, 12, 7.5], [0.5, 12, 8]])


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ("1,0.5,10,7.25\n2,0.5,12,8\n", "row 1 of its point cloud has 4 cells"),  # counted rows: 8 numbers
        ("0.5,10,7.25\nZ,0.5,12,8,-1,1\n", "row 2 of its point cloud has 6 cells"),
    ],
)
def test_a_stray_cell_in_a_point_cloud_of_gocator_is_refused(tmp_path, rows, reason):
    (tmp_path / "scan.csv").write_text(f"{GOCATOR}SurfacePointCloud\nFrame,Source\n0,0\nx,y,z\n{rows}End\n")
    with pytest.raises(InputError, match=reason):
        read_cloud(tmp_path / "scan.csv")


def test_commas_at_the_ends_of_rows_of_gocator_are_no_points(tmp_path):
    rows = "0.5,10,7.25,-1.5,12,7.5,\n0.5,12,8,,,,\n"
    (tmp_path / "scan.csv").write_text(f"{GOCATOR}SurfacePointCloud\nFrame,Source\n0,0\nx,y,z\n{rows}End\n")
    assert np.array_equal(read_cloud(tmp_path / "scan.csv").points, [[0.5, 10, 7.25], [-1.5, 12, 7.5], [0.5, 12, 8]])


def ptx(T):
    """A scan of one column: the scanner's place, its three axes, then the matrix for rows of points."""
    place, axes = T[:3, 3], T[:3, :3].T
    lines = [place, *axes, *T.T]
    return "4\n1\n" + "".join(" ".join(f"{x:.7f}" for x in line) + "\n" for line in lines) + FOUR_POINTS


def pcd(viewpoint):
    rows = "".join(" ".join(line.split()[:3]) + "\n" for line in FOUR_POINTS.splitlines())
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 4\nHEIGHT 1\n"
    return f"{head}VIEWPOINT {viewpoint}\nPOINTS 4\nDATA ascii\n{rows}"


def test_poses_in_the_headers_of_ptx_and_pcd_are_read(tmp_path):
    half = np.sqrt(0.5)
    samples = {".ptx": (ptx(AS_IT_IS), ptx(TURNED)), ".pcd": (pcd("0 0 0 1 0 0 0"), pcd(f"1 2 3 {half} 0 0 {half}"))}
    for suffix, texts in samples.items():
        files = [tmp_path / f"{name}{suffix}" for name in ("a", "b")]
        for file, text in zip(files, texts, strict=True):
            file.write_text(text)
        assert np.allclose(poses_in_scans(files), [AS_IT_IS, TURNED])
        assert poses_in_scans([files[0], files[0]]) is None  # all the same: nobody wrote poses there
    assert poses_in_scans([tmp_path / "a.ptx", tmp_path / "b.pcd"]) is None


def test_poses_in_the_headers_of_e57_are_read(tmp_path):
    pye57 = needs("pye57", "formats")
    columns = {f"cartesian{axis}": np.arange(4.0) + k for k, axis in enumerate("XYZ")}
    files = [tmp_path / f"{name}.e57" for name in "ab"]
    for file, places in zip(files, ([0.0, 0, 0], [1.0, 2, 3]), strict=True):
        with pye57.E57(str(file), mode="w") as written:
            quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
            written.write_scan_raw(columns, rotation=quarter, translation=np.array(places))
    assert np.allclose(poses_in_scans(files)[1], TURNED)
    assert np.allclose(poses_in_scans(files)[0, :3, 3], 0)
    assert times_in_scans(files) is None  # nobody wrote them
    sizes = {f"{axis}{end}": float(end == "Maximum") for axis in "xyz" for end in ("Minimum", "Maximum")}
    for file, seconds in zip(files, (1_400_000_000.25, 1_400_000_007.75), strict=True):
        with pye57.E57(str(file), mode="w") as written:
            header = SimpleNamespace(**sizes, acquisitionStart_dateTimeValue=seconds)
            written.write_scan_raw(columns, scan_header=header)
    # 16,203 days, 16 h 53 min 20 s from 1980-01-06.
    assert times_in_scans(files) == ["2024-05-17T16:53:20.250000", "2024-05-17T16:53:27.750000"]
    with pye57.E57(str(tmp_path / "two.e57"), mode="w") as written:
        written.write_scan_raw(columns)
        written.write_scan_raw(columns)
    with pytest.raises(InputError, match="holds 2 scans"):
        read_cloud(tmp_path / "two.e57")


def test_several_scans_in_a_ptx_are_refused(tmp_path):
    (tmp_path / "s.ptx").write_text(ptx(AS_IT_IS) + ptx(TURNED))
    with pytest.raises(InputError, match="to a file of its own"):
        read_cloud(tmp_path / "s.ptx")


def test_a_folder_of_such_scans_needs_no_table(tmp_path):
    rng = np.random.default_rng(0)
    for i in range(4):
        T = AS_IT_IS.copy()
        T[:3, 3] = 0.4, 0.1 * i, 0.5
        rows = "".join(f"{x:.4f} {y:.4f} {0.4 + 0.1 * x:.4f} 1\n" for x, y in rng.uniform(-0.1, 0.1, (400, 2)))
        (tmp_path / f"pos{i}.ptx").write_text(ptx(T).replace(FOUR_POINTS, rows).replace("4\n1\n", "400\n1\n", 1))
    first = first_session(tmp_path, StatedFolder())
    files = next(guess for guess in first.guesses if guess.what == "files")
    assert "4 poses in their headers" in files.value and first.pairing.by_name
    assert first.choice.best.interpretation.length_unit == "m"
