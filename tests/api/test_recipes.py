"""The blocks of the page of recipes, each run with a scan as its SDK hands it out, or with rows of a robot's log.

Devices are stand-ins with the calls and the memory layout of the SDK's documentation; Open3D and trimesh are themselves.
"""

import ctypes
import re
import sys
from contextlib import chdir, nullcontext
from pathlib import Path
from types import SimpleNamespace as Made

import numpy as np
import pytest
import trimesh
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import stitch
from stitch.plugins.intake.layouts import possible_layouts
from stitch.plugins.intake.raw_poses import read_raw_poses
from stitch.plugins.intake.readings import readings
from stitch.session.reading.arrays import cloud_of, poses_of
from tests.needs import needs_open3d

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "recipes.md").read_text(encoding="utf-8")
H, W = 30, 40
EMPTY = np.arange(H * W).reshape(H, W) % 7 == 0  # nothing was measured there


def block(title, language="python"):
    """The last block of a language in a section of the page."""
    section = re.split(r"^#{2,} ", TEXT.split(f"# {title}\n", 1)[1], flags=re.MULTILINE)[0]
    return re.findall(rf"^```{language}\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)[-1]


def surface(step=0.5):
    """A curved surface before the scanner, (H, W, 3) mm; x and y on a grid, z of 16 bits, none at 0."""
    x, y = np.meshgrid(step * np.arange(W) - 9.7, step * np.arange(H) - 7.3)
    return np.dstack([x, y, 400 + 0.02 * x**2 - 0.03 * x * y])


def image(nothing):
    """The surface as float32, with `nothing` where nothing was measured."""
    return np.where(EMPTY[..., None], nothing, surface()).astype(np.float32)


def realsense():
    class Points:
        def get_vertices(self):
            xyz = np.dtype([("f0", "<f4"), ("f1", "<f4"), ("f2", "<f4")])
            return (image(0) / np.float32(1e3)).reshape(-1).view(xyz)

    frames = Made(get_depth_frame=lambda: "depth")
    pipeline = Made(start=lambda: None, wait_for_frames=lambda: frames)
    calculated = {"depth": Points()}
    return {"pyrealsense2": Made(pipeline=lambda: pipeline, pointcloud=lambda: Made(calculate=calculated.get))}


def zivid():
    data = {"xyz": image(np.nan), "rgba_srgb": np.full((H, W, 4), 9, np.uint8)}
    frame = Made(point_cloud=lambda: Made(copy_data=data.get))
    camera = Made(capture_2d_3d=lambda settings: frame)
    application = Made(connect_camera=lambda: camera)
    return {"zivid": Made(Application=lambda: application, Settings=Made(load=lambda file: file))}


def phoxi():
    empty = Made(data_format="Coord3D_ABC32f", width=0, height=0, data=np.zeros(0, np.float32))
    texture = Made(data_format="Mono16", width=W, height=H, data=np.zeros(H * W, np.uint16))
    cloud, normals = (
        Made(data_format="Coord3D_ABC32f", width=W, height=H, data=x.ravel()) for x in (image(0), image(1))
    )
    buffer = nullcontext(Made(payload=Made(components=[texture, empty, cloud, normals])))
    nodes = Made(PhotoneoTriggerMode=Made(value=""), TriggerFrame=Made(execute=lambda: None))
    scanner = Made(remote_device=Made(node_map=nodes), start=lambda: None, fetch=lambda timeout: buffer)
    harvester = Made(add_file=lambda file: None, update=lambda: None, create=lambda which: scanner)
    core = Made(Harvester=lambda: harvester)
    return {"harvesters": Made(core=core), "harvesters.core": core}


def mecheye():
    frame = Made(get_untextured_point_cloud=lambda: Made(data=lambda: image(np.nan)))
    camera = Made(connect=lambda address: None, capture_3d=lambda frame: None)
    module = Made(Camera=lambda: camera, Frame3D=lambda: frame)
    return {"mecheye": Made(area_scan_3d_camera=module), "mecheye.area_scan_3d_camera": module}


def kinect():
    whole = np.round(image(0)).astype(np.int16)
    camera = Made(start=lambda: None, get_capture=lambda: Made(depth_point_cloud=whole))
    return {"pyk4a": Made(PyK4A=lambda: camera)}


def gocator():
    """GoSdk: a grid of 0.5 mm, heights in steps of 20 µm from 400 mm on."""
    counts = np.where(EMPTY, -32768, np.round((surface()[..., 2] - 400) / 0.02)).astype(np.int16)

    def row(message, index):
        return counts[index:].ctypes.data_as(ctypes.POINTER(ctypes.c_int16))

    told = {"Length": H, "Width": W, "XOffset": -9700, "YOffset": -7300, "ZOffset": 400_000}
    told |= {"XResolution": 500_000, "YResolution": 500_000, "ZResolution": 20_000}
    calls = {f"GoUniformSurfaceMsg_{name}": lambda message, value=value: value for name, value in told.items()}
    return {"sdk": Made(**calls, GoUniformSurfaceMsg_RowAt=row), "message": 1}


SCANNERS = {
    "RealSense": (realsense, 1e-4),
    "Zivid": (zivid, 1e-4),
    "Photoneo PhoXi": (phoxi, 1e-4),
    "Mech-Eye": (mecheye, 1e-4),
    "Gocator": (gocator, 0.0101),  # half a step
    "Azure Kinect": (kinect, 0.5),
}


@pytest.mark.parametrize("title", SCANNERS)
def test_a_scanner_hands_out_what_it_measured(title, monkeypatch):
    given, within = SCANNERS[title]
    names = {}
    for name, made in given().items():
        monkeypatch.setitem(sys.modules, name, made)
        names[name] = made
    exec(compile(block(title), title, "exec"), names)
    cloud = cloud_of(names["scan"](), "view v000")
    assert cloud.points.shape == (np.sum(~EMPTY), 3)
    assert np.abs(cloud.points - surface()[~EMPTY]).max() <= within
    assert "red" in cloud.scalars or title != "Zivid"


@pytest.mark.parametrize("title", ["Open3D", "trimesh"])
def test_a_file_as_an_object_of_its_library(title, tmp_path):
    if title == "Open3D":
        needs_open3d()
    measured = surface().reshape(-1, 3)
    trimesh.PointCloud(measured).export(tmp_path / "scan.ply")
    names = {}
    with chdir(tmp_path):
        exec(compile(block(title), title, "exec"), names)
        cloud = cloud_of(names["scan"](), "view v000")
    assert np.abs(cloud.points - measured).max() < 1e-4


def test_the_loop_gives_the_session_of_what_was_scanned(arrays, found, monkeypatch, capsys):
    clouds, poses = map(iter, arrays)
    monkeypatch.setattr(stitch, "run", lambda session: found, raising=False)
    names = {"stops": range(5), "move_to": lambda stop: None}
    names |= {"scan": lambda: next(clouds), "flange_pose": lambda: next(poses)}
    exec(compile(block("Recipes"), "Recipes", "exec"), names)
    views = names["session"].views
    assert all((view.cloud.points == cloud).all() for view, cloud in zip(views, arrays[0], strict=True))
    assert all((view.T_base_flange == T).all() for view, T in zip(views, arrays[1], strict=True))
    assert "T_flange_scanner" in capsys.readouterr().out


def test_a_topic_of_ros_is_judged_scan_by_scan(cell, monkeypatch, capsys):
    """Scans in metres in padded records of PointCloud2, NaN where nothing was measured."""
    record = np.dtype({"names": [*"xyz"], "formats": ["<f4"] * 3, "offsets": [0, 4, 8], "itemsize": 32})

    def read_points(message, field_names):
        return np.frombuffer(message.data, record)[field_names]

    def message(points, stamp):
        data = np.full(len(points) + 5, np.nan, record)
        for name, column in zip("xyz", points.T / 1e3, strict=True):
            data[name][5:] = column
        return Made(data=data.tobytes(), header=Made(stamp=stamp))

    def lookup_transform(target, source, stamp):
        T = cell.T_base_flange[stamp]
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        shift, turn = (Made(**dict(zip("xyzw", map(float, numbers), strict=False))) for numbers in (T[:3, 3] / 1e3, q))
        return Made(transform=Made(translation=shift, rotation=turn))

    module = Made(read_points=read_points)
    monkeypatch.setitem(sys.modules, "sensor_msgs_py", Made(point_cloud2=module))
    monkeypatch.setitem(sys.modules, "sensor_msgs_py.point_cloud2", module)
    names = {"stitch": stitch, "buffer": Made(lookup_transform=lookup_transform)}
    exec(compile(block("ROS 2"), "ROS 2", "exec"), names)
    for stamp, cloud in enumerate(cell.clouds):
        names["on_scan"](message(cloud.points, stamp))
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 5 and "The first hand-eye." in said[3] and "does not belong" not in said[4]


AXES = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}


def turned(vector):
    """The rotation (3, 3) by a vector (3,), rad, without the library that the page uses."""
    x, y, z = vector
    return expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))


def fixed(w, p, r):
    """Turns in degrees about x, then y, then z, axes that stand still: W, P, R of FANUC; C, B, A of KUKA."""
    x, y, z = (turned(np.radians(angle) * np.array(AXES[axis])) for axis, angle in zip("xyz", (w, p, r), strict=True))
    return z @ y @ x


def halved(vector):
    """The quaternion of a rotation vector, real part first."""
    angle = np.linalg.norm(vector)
    return np.array([np.cos(angle / 2), *np.sin(angle / 2) * vector / angle])


def log_of(robot):
    """Rows of numbers (5, 6 or 7) in the order of a robot's log, and the poses (5, 4, 4) that they are, mm."""
    rng = np.random.default_rng(4)
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, 3] = rng.uniform(-900, 900, (5, 3))
    angles, vectors = rng.uniform(-80, 80, (5, 3)), rng.uniform(-1, 1, (5, 3))
    of_turns = {
        "KUKA": (angles, [fixed(c, b, a) for a, b, c in angles]),
        "FANUC": (angles, [fixed(*wpr) for wpr in angles]),
        "ABB": ([halved(v) for v in vectors], [turned(v) for v in vectors]),
        "Universal Robots": (vectors, [turned(v) for v in vectors]),
    }
    turns, T[:, :3, :3] = of_turns[robot]
    return np.hstack([T[:, :3, 3] / (1e3 if robot == "Universal Robots" else 1), turns]), T


def written(robot, rows):
    """The log: the line of the page, with these numbers in the place of its own, and names of scans before them."""
    number = re.compile(r"-?\d+\.\d+")
    (line,) = block(robot, "text").splitlines()
    assert len(number.findall(line)) == rows.shape[1]
    form = number.sub("{:.9f}", line.replace("{", "{{").replace("}", "}}"))
    return "".join(f"scan{i}.ply {form.format(*row)}\n" for i, row in enumerate(rows))


@pytest.mark.parametrize("robot", ["KUKA", "ABB", "FANUC", "Universal Robots"])
def test_a_log_is_read_as_the_line_of_python_reads_it(robot, tmp_path):
    rows, T = log_of(robot)
    names = {"Rotation": Rotation, "rows": rows}
    exec(compile(block(robot), robot, "exec"), names)
    assert np.abs(poses_of(names["poses"], "poses") - T).max() < 1e-9
    (tmp_path / "poses.log").write_text(written(robot, rows), encoding="utf-8")
    (layout,) = possible_layouts(read_raw_poses([tmp_path / "poses.log"]))
    found = readings(layout)[0].T.copy()
    found[:, :3, 3] *= 1e3 if layout.length_unit == "m" else 1.0
    assert np.abs(found - T).max() < 1e-5
