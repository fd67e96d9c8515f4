"""The hand-eye in the form of other programs, read back by readers that are none of ours."""

import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.run_folders import bare_run
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.plugins.export.hand_eye_formats import HAND_EYE_FORMATS, hand_eye_of_run
from tests.command_line import ended

NUMBER = r"(-?\d+\.\d+)"
COVARIANCE = np.diag([1e-4, 2e-4, 3e-4, 0.02, 0.05, 0.04]) ** 2
COVARIANCE[0, 4] = COVARIANCE[4, 0] = 0.5 * 1e-4 * 0.05


def pose(rotation, xyz=(61.5, -22.25, 140.125)):
    """mm"""
    return frames.make(rotation.as_matrix(), np.array(xyz))


# One anywhere, one where KUKA's and FANUC's angles lock, one at half a turn.
POSES = [
    pose(Rotation.from_rotvec([0.3, -1.1, 0.7])),
    pose(Rotation.from_euler("ZYX", [25, 90, -40], degrees=True)),
    pose(Rotation.from_rotvec(np.pi * np.array([0.6, -0.8, 0]))),
]
ANYWHERE = POSES[0]


def numbers(text: str) -> np.ndarray:
    """Those of the last line that has any: above stand comments."""
    lines = [line for line in text.splitlines() if not line.startswith((";", "!", "#"))]
    return np.array([float(x) for x in re.findall(NUMBER, " ".join(lines))])


READERS = {
    "kuka": lambda n: pose(Rotation.from_euler("ZYX", n[3:], degrees=True), n[:3]),
    "fanuc": lambda n: pose(Rotation.from_euler("xyz", n[3:], degrees=True), n[:3]),
    "abb": lambda n: pose(Rotation.from_quat(n[[4, 5, 6, 3]]), n[:3]),
    "ur": lambda n: pose(Rotation.from_rotvec(n[3:]), n[:3] * 1000),
}


@pytest.mark.parametrize("T", POSES)
@pytest.mark.parametrize("controller", READERS)
@pytest.mark.parametrize("unit", ["mm", "m"])
def test_controllers_frames_by_scipys_conventions(controller, T, unit, tmp_path):
    own = T.copy()
    own[:3, 3] /= {"mm": 1, "m": 1000}[unit]
    text = HAND_EYE_FORMATS[controller](hand_eye_of_run(bare_run(tmp_path / "r", own, COVARIANCE, length_unit=unit)))
    read = READERS[controller](numbers(text))
    assert read[:3, 3] == pytest.approx(T[:3, 3], abs=1e-5)  # nine digits of a metre
    assert read[:3, :3] == pytest.approx(T[:3, :3], abs=1e-8)


def test_opencv_reads_its_own_storage(tmp_path):
    cv2 = pytest.importorskip("cv2")
    file = tmp_path / "hand_eye.yaml"
    run = bare_run(tmp_path / "r", ANYWHERE, COVARIANCE, name='blade "17"')
    ended("export", run, "--to", "opencv", "-o", file)
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    assert np.array_equal(storage.getNode("T_flange_scanner").mat(), ANYWHERE)
    assert np.array_equal(storage.getNode("covariance").mat(), COVARIANCE)
    told = [storage.getNode(name).string() for name in ("session", "parent", "child", "length_unit")]
    assert told == ['blade "17"', "flange", "scanner", "mm"]


def yaml_by_opencv(text):
    """OpenCV's reader of YAML asks for its own head."""
    cv2 = pytest.importorskip("cv2")
    return cv2.FileStorage(f"%YAML:1.0\n---\n{text}", cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)


def test_ros_2_launch_file_in_yaml(tmp_path):
    run = bare_run(tmp_path / "r", ANYWHERE, COVARIANCE, mount="eye_to_hand")
    document = yaml_by_opencv(HAND_EYE_FORMATS["ros"](hand_eye_of_run(run, child="camera")))
    node = document.getNode("launch").at(0).getNode("node")
    told = [node.getNode(key).string() for key in ("pkg", "exec", "name")]
    assert told == ["tf2_ros", "static_transform_publisher", "base_link_to_camera"]
    words = node.getNode("args").string().split()
    flags = dict(zip(words[::2], words[1::2], strict=True))
    assert (flags["--frame-id"], flags["--child-frame-id"]) == ("base_link", "camera")
    same(flags["--x"], flags["--y"], flags["--z"], Rotation.from_quat([float(flags[f"--q{a}"]) for a in "xyzw"]))


def test_ros_1_launch_file_by_its_ending(tmp_path, stitch_command):
    run = bare_run(tmp_path / "r", ANYWHERE, COVARIANCE)
    stitch_command("export", run, "--to", "ros", "-o", tmp_path / "scanner.launch")
    node = ElementTree.parse(tmp_path / "scanner.launch").getroot().find("node")
    *values, parent, child = node.get("args").split()
    assert (node.get("pkg"), parent, child) == ("tf2_ros", "flange", "scanner")
    same(*values[:3], Rotation.from_quat([float(x) for x in values[3:]]))


@pytest.mark.parametrize("T", POSES)
def test_urdf_link_and_joint(T, tmp_path):
    run = bare_run(tmp_path / "r", T, COVARIANCE)
    root = ElementTree.fromstring(HAND_EYE_FORMATS["urdf"](hand_eye_of_run(run, parent="tool0")))
    joint = root.find("joint")
    assert joint.get("type") == "fixed" and joint.find("parent").get("link") == "tool0"
    assert [link.get("name") for link in root.iter("link")] == ["scanner"]
    xyz, rpy = ([float(x) for x in joint.find("origin").get(key).split()] for key in ("xyz", "rpy"))
    same(*xyz, Rotation.from_euler("xyz", rpy), T)


def test_urdf_takes_its_place_in_a_robot(tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy")
    run = bare_run(tmp_path / "r", ANYWHERE, COVARIANCE)
    inner = HAND_EYE_FORMATS["urdf"](hand_eye_of_run(run)).split("<robot")[1].split(">", 1)[1].rsplit("</robot>", 1)[0]
    (tmp_path / "r.urdf").write_text(f'<robot name="r"><link name="flange"/>{inner}</robot>')
    T = yourdfpy.URDF.load(str(tmp_path / "r.urdf")).get_transform("scanner", "flange")
    same(*T[:3, 3], Rotation.from_matrix(T[:3, :3]))


def test_zivids_matrix(tmp_path):
    run = bare_run(tmp_path / "r", ANYWHERE, COVARIANCE)
    document = yaml_by_opencv(HAND_EYE_FORMATS["zivid"](hand_eye_of_run(run)))
    rows = document.getNode("FloatMatrix").getNode("Data")
    read = [[rows.at(i).at(k).real() for k in range(4)] for i in range(4)]
    assert np.array(read) == pytest.approx(ANYWHERE, abs=1e-12)
    assert [document.getNode("__version__").getNode(key).real() for key in ("serializer", "data")] == [1, 1]


@pytest.mark.parametrize("controller", READERS)
def test_expanded_uncertainty_is_that_of_drawn_hand_eyes(controller, tmp_path):
    """20,000 hand-eyes drawn from the covariance, read by scipy alone: two of their standard deviations."""
    text = HAND_EYE_FORMATS[controller](hand_eye_of_run(bare_run(tmp_path / "r", ANYWHERE, COVARIANCE)))
    line = next(line for line in text.splitlines() if "U (k = 2)" in line)
    stated = np.array([float(x) for x in re.findall(r" ([\d.e-]+)(?: (?:mm|m|rad|°))?(?:,|$)", line.split(":")[1])])
    xi = np.random.default_rng(0).multivariate_normal(np.zeros(6), COVARIANCE, 20_000)
    turned = Rotation.from_matrix(ANYWHERE[:3, :3]) * Rotation.from_rotvec(xi[:, :3])
    moved = xi[:, 3:] @ ANYWHERE[:3, :3].T
    drawn = {
        "kuka": lambda: np.hstack([moved, turned.as_euler("ZYX", degrees=True)]),
        "fanuc": lambda: np.hstack([moved, turned.as_euler("xyz", degrees=True)]),
        "abb": lambda: np.hstack([moved, turned.as_quat(canonical=True)[:, [3, 0, 1, 2]]]),
        "ur": lambda: np.hstack([moved / 1000, turned.as_rotvec()]),
    }[controller]()
    # 20,000 draws know a standard deviation within 0.5 %; two digits are printed.
    assert stated == pytest.approx(2 * drawn.std(axis=0), rel=0.06)


def test_what_the_numbers_do_not_hold_is_said(tmp_path):
    run = bare_run(
        tmp_path / "r",
        ANYWHERE,
        COVARIANCE,
        unobservable=["rotation about z"],
        effects={"mount_drift": {"rx": (1e-4, "rad/h")}},
    )
    for write in HAND_EYE_FORMATS.values():
        text = write(hand_eye_of_run(run))
        assert "Not observable from these motions, left at the coarse value: rotation about z" in text
        assert "mount_drift" in text and "flange" in text


@pytest.mark.parametrize(
    ("verdict", "said"),
    [
        (None, "whether an effect is missing has not been asked"),
        ("adequate", "no effect is found missing"),
        ("missing_effect", "too small until the effect is added"),
        ("unknown_effect", "hold for a complete model, and something without a name is missing"),
    ],
)
def test_an_uncertainty_says_of_which_model_it_is(verdict, said, tmp_path):
    run = bare_run(tmp_path / "r", ANYWHERE, COVARIANCE)
    if verdict:
        (run / "diagnosis.json").write_text(json.dumps({"verdict": verdict}))
    for write in HAND_EYE_FORMATS.values():
        assert said in write(hand_eye_of_run(run))


def test_what_an_unseen_effect_could_do_leaves_with_the_numbers(tmp_path):
    """U counts no effect that the views do not show."""
    run = bare_run(tmp_path / "r", ANYWHERE, COVARIANCE)
    sizes = {"range_scale": 0.269, "part_growth": None, "joint_offset": 0.02}
    candidates = [{"effect": name, "hand_eye_if_missed": size} for name, size in sizes.items()]
    (run / "diagnosis.json").write_text(json.dumps({"verdict": "adequate", "candidates": candidates}))
    for write in HAND_EYE_FORMATS.values():
        assert "could displace it, at the part, by as much as 269 µm (range_scale)" in write(hand_eye_of_run(run))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "lego"], "--to lego: no such format; to fix: one of hand-eye: ros, urdf"),
        (["--to", "rso"], "--to rso: no such format; did you mean 'ros'?; to fix: one of"),
        (["--to", "ros", "--parent", "my flange"], "--parent 'my flange': to fix"),
        (["--to", "ros", "-o", "taken.yaml"], "taken.yaml: exists already"),
        (["--to", "ros", "-o", "no/scanner.yaml"], "no/scanner.yaml: there is no folder no; to fix: make it"),
    ],
)
def test_bad_requests_write_nothing(arguments, message, tmp_path, monkeypatch):
    run = bare_run(tmp_path / "r", ANYWHERE, COVARIANCE)
    monkeypatch.chdir(tmp_path)
    Path("taken.yaml").write_text("mine")
    out = ended("export", run, *arguments, code=2)
    assert message in out.err and not out.out
    assert Path("taken.yaml").read_text() == "mine" and len(list(tmp_path.iterdir())) == 2


def test_no_run_is_one_line(tmp_path):
    with pytest.raises(InputError, match=r"nowhere: no such run folder"):
        hand_eye_of_run(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"result.json: not found"):
        hand_eye_of_run(tmp_path)
    (tmp_path / "rig").mkdir()
    inner = bare_run(tmp_path / "rig" / "monday", ANYWHERE, COVARIANCE)
    (tmp_path / "rig" / "model.toml").write_bytes((inner / "model.toml").read_bytes())
    with pytest.raises(InputError, match=r"rig: holds the runs of several sessions \(monday\); name one of them"):
        hand_eye_of_run(tmp_path / "rig")


def same(x, y, z, rotation, T=ANYWHERE):
    assert [float(a) for a in (x, y, z)] == pytest.approx(T[:3, 3] / 1000, abs=1e-12)
    assert rotation.as_matrix() == pytest.approx(T[:3, :3], abs=1e-9)


def test_json_alone_stands_on_standard_output(tmp_path, stitch_command):
    run, file = bare_run(tmp_path / "r", ANYWHERE, COVARIANCE), tmp_path / "scanner.txt"
    text = HAND_EYE_FORMATS["kuka"](hand_eye_of_run(run))
    assert json.loads(stitch_command("export", run, "--to", "kuka", "--json")) == {
        "to": "kuka",
        "text": text,
        "files": [],
    }
    told = json.loads(stitch_command("export", run, "--to", "kuka", "-o", file, "--json"))
    assert told == {"to": "kuka", "text": text, "files": [str(file)]}
    assert file.read_text(encoding="utf-8") == text
