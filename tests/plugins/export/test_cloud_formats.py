"""The stitched cloud in other formats, read back by libraries that did not write it."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from data_synth.fixtures.run_folders import bare_run
from stitch.output.run_folder import write_cloud
from stitch.run_data import FusedCloud
from tests.command_line import ended
from tests.needs import needs

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-200, 900, (300, 3)).astype(np.float32).astype(float)
NORMALS = np.tile([0.0, 0.6, 0.8], (300, 1))
RESIDUAL = np.append(np.linspace(0, 0.05, 280), np.full(20, np.nan))
GREY, DARK, BRIGHT = (150, 150, 150), (68, 1, 84), (253, 231, 37)  # the ends of viridis, as published


@pytest.fixture(params=["mm", "m"])
def cloud(request, tmp_path):
    """A run with a stitched cloud, the metres of its unit, and how to export it."""
    run = bare_run(tmp_path / "r", np.eye(4), np.eye(6), length_unit=request.param)
    write_cloud(FusedCloud(POINTS, NORMALS, RESIDUAL, np.full(300, 2)), run / "stitched.ply")

    def export(kind, *options):
        ended("export", run, "--to", kind, "-o", tmp_path / f"c.{kind}", *options)
        return str(tmp_path / f"c.{kind}")

    return export, {"mm": 1e-3, "m": 1.0}[request.param]


def coloured(colours):
    """Dark at zero, bright at the end, grey where nobody knows."""
    colours = np.asarray(colours)
    return [tuple(int(c) for c in colours[i]) for i in (0, 279, 299)] == [DARK, BRIGHT, GREY]


def test_ply_by_open3d(cloud):
    o3d = pytest.importorskip("open3d")
    export, _ = cloud
    read = o3d.io.read_point_cloud(export("ply"))
    assert np.allclose(read.points, POINTS) and np.allclose(read.normals, NORMALS)
    assert coloured(np.round(np.asarray(read.colors) * 255))


def test_pcd_by_open3d(cloud):
    o3d = pytest.importorskip("open3d")
    export, _ = cloud
    read = o3d.t.io.read_point_cloud(export("pcd"))
    assert np.allclose(read.point.positions.numpy(), POINTS) and np.allclose(read.point.normals.numpy(), NORMALS)
    assert coloured(read.point.colors.numpy())
    assert np.allclose(read.point["residual"].numpy()[:, 0], RESIDUAL, equal_nan=True)


@pytest.mark.parametrize("kind", ["las", "laz"])
def test_las_by_laspy(cloud, kind):
    laspy = needs("laspy", "formats")
    export, _ = cloud
    read = laspy.read(export(kind))
    assert np.abs(read.xyz - POINTS).max() <= 0.5e-6  # 900 units in steps of 32 bits and whole powers of ten
    assert coloured(np.column_stack([read.red, read.green, read.blue]) // 257)
    assert np.allclose(read["residual"], RESIDUAL, equal_nan=True) and np.allclose(read["nz"], 0.8)


def test_e57_by_pye57_in_metres(cloud):
    pye57 = needs("pye57", "formats")
    export, metres = cloud
    read = pye57.E57(export("e57")).read_scan(0, colors=True, ignore_missing_fields=True)
    assert np.allclose(np.column_stack([read[f"cartesian{a}"] for a in "XYZ"]), POINTS * metres)
    assert coloured(np.column_stack([read[f"color{c}"] for c in ("Red", "Green", "Blue")]))


def gltf(file):
    """Arrays of the only primitive of a binary glTF, after its specification; what it draws."""
    raw = Path(file).read_bytes()
    assert raw[:4] == b"glTF" and struct.unpack("<I", raw[4:8])[0] == 2
    size = struct.unpack("<I", raw[12:16])[0]
    document, data = json.loads(raw[20 : 20 + size]), raw[28 + size :]
    primitive = document["meshes"][0]["primitives"][0]
    kinds = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
    widths = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

    def array(index):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        begin = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        width = widths[accessor["type"]]
        flat = np.frombuffer(data, kinds[accessor["componentType"]], accessor["count"] * width, begin)
        return flat.reshape(-1, width)

    own = {name: array(index) for name, index in primitive["attributes"].items()}
    return own, array(primitive["indices"]) if "indices" in primitive else None, primitive.get("mode", 4)


def test_glb_by_its_specification(cloud):
    export, metres = cloud
    own, _, mode = gltf(export("glb"))
    assert mode == 0  # points
    assert np.allclose(own["POSITION"], POINTS * metres, rtol=1e-6)
    assert coloured(own["COLOR_0"][:, :3])


def write_mesh(file):
    """A triangle between three of the points."""
    vertices = np.array([tuple(POINTS[i]) for i in (0, 279, 299)], [(a, "<f8") for a in "xyz"])
    faces = np.array([([0, 1, 2],)], [("vertex_indices", "<i4", (3,))])
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements).write(str(file))


def test_glb_of_a_run_with_a_mesh_is_the_mesh(cloud, tmp_path):
    export, metres = cloud
    write_mesh(tmp_path / "r" / "mesh.ply")
    own, indices, mode = gltf(export("glb"))
    assert mode == 4 and indices.ravel().tolist() == [0, 1, 2]  # triangles
    assert np.allclose(own["POSITION"], POINTS[[0, 279, 299]] * metres, rtol=1e-6)
    assert [tuple(c) for c in own["COLOR_0"][:, :3]] == [DARK, BRIGHT, GREY]


@pytest.mark.parametrize("kind", ["ply", "glb"])
def test_cloud_and_mesh_lie_in_the_frame_of_the_datum(cloud, tmp_path, kind):
    export, metres = cloud
    T = np.array([[0, -1, 0, 5.0], [1, 0, 0, -7.0], [0, 0, 1, 2.0], [0, 0, 0, 1]])
    (tmp_path / "r" / "features.json").write_text(json.dumps({"T_datum_reference": T.tolist()}))
    write_mesh(tmp_path / "r" / "mesh.ply")
    there = POINTS @ T[:3, :3].T + T[:3, 3]
    if kind == "ply":
        vertex = PlyData.read(export("ply", "--datum"))["vertex"]
        assert np.allclose(np.column_stack([vertex[a] for a in "xyz"]), there, atol=1e-3)
        assert np.allclose(vertex["nx"], -0.6) and np.allclose(vertex["ny"], 0.0)
    else:
        own, _, _ = gltf(export("glb", "--datum"))
        assert np.allclose(own["POSITION"], there[[0, 279, 299]] * metres, rtol=1e-5)
        assert [tuple(c) for c in own["COLOR_0"][:, :3]] == [DARK, BRIGHT, GREY]


def test_without_a_datum_there_is_no_frame_of_it(cloud, tmp_path):
    run = tmp_path / "r"
    (run / "features.json").write_text('{"T_datum_reference": null}')
    told = ended("export", run, "--to", "ply", "-o", tmp_path / "c.ply", "--datum", code=2)
    assert "features.json: says no datum; to fix: run stitch measure" in told.err
    assert "--datum: is of a cloud; to fix" in ended("export", run, "--to", "ros", "--datum", code=2).err


@pytest.mark.parametrize(
    ("kind", "output", "content", "message"),
    [
        ("ply", "c.pcd", b"", "--to ply: no output file; to fix: name the file with -o NAME.ply"),
        ("ply", "c.ply", None, "r/stitched.ply: no stitched cloud there"),
        (
            "ply",
            "c.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
            "r/stitched.ply: damaged",
        ),
        ("las", "c.las", "cloud", "needs the package laspy; to fix: pip install 'stitch-scans[formats]'"),
    ],
)
def test_clouds_that_cannot_be_written(kind, output, content, message, tmp_path, monkeypatch):
    run = bare_run(tmp_path / "r", np.eye(4), np.eye(6))
    if content == "cloud":
        write_cloud(FusedCloud(POINTS, NORMALS, RESIDUAL, np.full(300, 2)), run / "stitched.ply")
    elif content is not None:
        (run / "stitched.ply").write_bytes(content)
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    told = ended("export", run, "--to", kind, "-o", tmp_path / output, code=2)
    assert message in told.err
    assert [path.name for path in tmp_path.iterdir()] == ["r"]
