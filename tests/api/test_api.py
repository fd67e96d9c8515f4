"""Every public name says shapes, units, frames and errors; its example is run, as are the blocks of the page of recipes."""

import ast
import ctypes
import doctest
import inspect
import re
import sys
from contextlib import chdir, nullcontext
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path
from types import SimpleNamespace
from types import SimpleNamespace as Made
from typing import get_args, get_type_hints

import numpy as np
import pytest
import trimesh
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import stitch
from data_synth.fixtures.sphere_scans import sphere_cell, write_spheres
from stitch.plugins.intake.layouts import possible_layouts
from stitch.plugins.intake.raw_poses import read_raw_poses
from stitch.plugins.intake.readings import readings
from stitch.session.reading.arrays import cloud_of, poses_of
from stitch.session.session import Cloud
from tests.needs import needs_open3d

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
# How a method begins that returns what it did.
VERBS = {"Return", "Write", "Take", "Run"}
ERRORS = {"InputError", "NoResultError"}


def classes_in(hint):
    """Classes of stitch in a type."""
    own = {hint} if inspect.isclass(hint) and hint.__module__.startswith("stitch.") else set()
    return own.union(*map(classes_in, get_args(hint)))


def returned(member):
    """Classes of stitch that a function, method or property returns."""
    function = getattr(member, "fget", None) or getattr(member, "func", None) or getattr(member, "__func__", member)
    return classes_in(get_type_hints(function).get("return")) if inspect.isfunction(function) else set()


def held():
    """The public classes, and whatever one reaches from public functions by methods and properties."""
    public = [getattr(stitch, name) for name in stitch.__all__]
    waiting = [kind for kind in public if inspect.isclass(kind) and not issubclass(kind, Exception)]
    waiting += sorted(set().union(*map(returned, public)), key=lambda kind: kind.__name__)
    found = []
    while waiting:
        kind = waiting.pop(0)
        # Of a class and the one that people hold in its place the second counts.
        if any(issubclass(other, kind) for other in found):
            continue
        found.append(kind)
        waiting += sorted(set().union(*map(returned, members(kind).values())), key=lambda kind: kind.__name__)
    return found


def members(kind):
    """Public members of a class, own and inherited, by the name under which people call them."""
    names = [name for name in dir(kind) if not name.startswith("_")]
    return {f"{kind.__name__}.{name}": inspect.getattr_static(kind, name) for name in names}


HELD = held()
MEMBERS = {name: member for kind in HELD for name, member in members(kind).items()}
METHODS = {name: f for name, m in MEMBERS.items() if inspect.isfunction(f := getattr(m, "__func__", m))}
PROPERTIES = {name: m for name, m in MEMBERS.items() if isinstance(m, property | cached_property)}
CLASSES = {kind.__name__: kind for kind in HELD}
FUNCTIONS = {name: getattr(stitch, name) for name in stitch.__all__ if inspect.isfunction(getattr(stitch, name))}
NAMES = {name: getattr(stitch, name) for name in stitch.__all__} | CLASSES | METHODS


def example_of(name, globs=None):
    """The example of a public name, with what it finds there."""
    return doctest.DocTestParser().get_doctest(inspect.getdoc(NAMES[name]), globs or {}, name, None, None)


def moved(view):
    """The view as if it had been scanned once more."""
    return replace(view, cloud=Cloud(view.cloud.points + 1e-6, None, view.cloud.scalars))


@pytest.fixture(scope="module")
def names_of_examples(arrays, cell_folder, loaded, found, better, tmp_path_factory):
    """What the examples call as a person would, but for the folder to write into."""
    clouds, poses = arrays
    grown = stitch.live(mount="eye_in_hand")
    for cloud, pose in zip(clouds, poses, strict=True):
        grown.add_view(cloud, pose)
    # What takes seconds is done once, for all examples that ask for it.
    slow = {name: cache(getattr(stitch, name)) for name in ("compare", "diagnose", "plan")}
    other = replace(loaded, name="other", views=tuple(moved(view) for view in loaded.views))
    balls = write_spheres(sphere_cell(3, "area"), tmp_path_factory.mktemp("balls") / "ball")
    place = len(found.stitched) // 2
    at, axis = found.stitched.points[place], found.stitched.normals[place]
    return {
        "stitch": SimpleNamespace(**{name: getattr(stitch, name) for name in stitch.__all__} | slow),
        "np": np,
        "replace": replace,
        "clouds": clouds,
        "poses": poses,
        "session": loaded,
        "other": other,
        "artefact": other,
        "plate": [stitch.Feature("patch", "plane", at=at, axis=axis, calibrated=0.0, calibrated_U=0.01)],
        "ball_session": stitch.load_session(balls, at_most=None),
        "session_folder": cell_folder,
        "run": found,
        "better": better,
        "live": grown,
    }


@pytest.mark.parametrize("name", NAMES)
def test_every_name_has_an_example(name):
    assert example_of(name).examples


# Ten seconds: a plan looks at forty views.
PLANS = [name for name in NAMES if any("stitch.plan(" in own.source for own in example_of(name).examples)]


# What they show the examples of the functions show too: seconds each.
TWICE = ["Calibration", "CheckedSession", "LiveSession.finish", "Proposal", "Verification"]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in [*PLANS, *TWICE])) for name in NAMES], ids=str
)
def test_the_example_gives_what_it_says(name, names_of_examples, tmp_path):
    if "open3d" in name:
        needs_open3d()
    if "to_pandas" in NAMES[name].__doc__:
        pytest.importorskip("pandas")
    said = []
    example = example_of(name, names_of_examples | {"folder": tmp_path})
    doctest.DocTestRunner(optionflags=FLAGS).run(example, out=said.append)
    assert not said, "".join(said)


@pytest.mark.parametrize("name", [*FUNCTIONS, "Session.from_arrays"])
def test_a_function_says_what_it_raises_and_in_which_units(name):
    text = NAMES[name].__doc__
    assert "Raises:" in text and "Example:" in text
    assert any(word in text for word in ("(4, 4)", "(V,", "(N, 3)", "length_unit", "rad", "mm")), name


@pytest.mark.parametrize("name", METHODS)
def test_a_method_begins_with_what_it_does_and_says_what_it_raises(name):
    text = inspect.getdoc(METHODS[name])
    assert text.split()[0] in VERBS
    assert "Raises:" in text or not refuses(METHODS[name].__name__)


@pytest.mark.parametrize("name", PROPERTIES)
def test_a_property_says_what_it_is_and_what_it_raises(name):
    text = PROPERTIES[name].__doc__
    assert text and re.match(r"[A-Z(`]", text)
    assert "Raises:" in text or not refuses(name.split(".")[1])


def calls_and_refusals():
    """Of every function of the rooms that people call: names that it calls, and whether it raises itself."""
    root = Path(stitch.__file__).parent
    files = [*(root / "api").glob("*.py"), root / "system" / "open3d_library.py"]
    trees = [ast.parse(file.read_text(encoding="utf-8")) for file in files]
    out = {}
    for node in (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        inside = list(ast.walk(node))
        called = {ast.unparse(n.func).split(".")[-1] for n in inside if isinstance(n, ast.Call)}
        raised = any(isinstance(n, ast.Raise) and n.exc and ast.unparse(n.exc).split("(")[0] in ERRORS for n in inside)
        # Of several of one name all count.
        before, refused = out.get(node.name, (set(), False))
        out[node.name] = before | called, refused or raised
    return out


CALLS = calls_and_refusals()


def refuses(name, above=()):
    """True if a function, or one that it calls there, raises InputError or NoResultError."""
    called, raised = CALLS.get(name, ((), False))
    return raised or any(refuses(other, (*above, name)) for other in called if other not in (*above, name))


def test_a_refusal_is_seen_through_the_functions_between():
    assert refuses("save") and refuses("to_open3d") and refuses("add_view") and not refuses("to_trimesh")


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


def orbbec():
    frames = {1000: "frames"}
    cloud = Made(process={"frames": "points"}.get, calculate={"points": image(0).reshape(-1, 3)}.get)
    pipeline = Made(start=lambda: None, wait_for_frames=frames.get)
    return {"pyorbbecsdk": Made(Pipeline=lambda: pipeline, PointCloudFilter=lambda: cloud)}


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
    "Orbbec": (orbbec, 1e-4),
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


def test_a_pose_by_rtde_is_that_of_the_controller(monkeypatch):
    told = [0.837754, 0.184587, 0.675455, 2.891104, 0.321870, -0.117293]
    receiver = Made(getActualTCPPose=lambda: told)
    monkeypatch.setitem(sys.modules, "rtde_receive", Made(RTDEReceiveInterface=lambda host: receiver))
    names = {}
    exec(compile(block("RTDE"), "RTDE", "exec"), names)
    (T,) = poses_of([names["flange_pose"]()], "poses")
    assert np.abs(T[:3, :3] - Rotation.from_rotvec(told[3:]).as_matrix()).max() < 1e-12
    assert np.abs(T[:3, 3] - 1e3 * np.array(told[:3])).max() < 1e-9


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


def test_the_hand_eye_that_moveit_saves_is_the_start(tmp_path, monkeypatch):
    R, t = Rotation.from_rotvec([0.1, -0.4, 2.0]), [0.05, -0.02, 0.11]
    args = " ".join(map(repr, [*t, *R.as_quat().tolist()]))
    node = f'<node pkg="tf2_ros" type="static_transform_publisher" name="eye" args="{args} tool0 camera" />'
    (tmp_path / "hand_eye.launch").write_text(f"<launch>\n  {node}\n</launch>\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(block("MoveIt's hand-eye"), "MoveIt", "exec"), names)
    assert np.allclose(names["scanner"]["pose"][:3, :3], R.as_matrix())
    assert np.allclose(names["scanner"]["pose"][:3, 3], [50, -20, 110])
