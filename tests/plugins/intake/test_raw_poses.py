"""Layouts of pose files, typed after what vendors and libraries publish; none of them by a writer of this project.

Folders whose poses stand in a program: which file is read, which points count.
"""

import json

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from data_synth.fixtures.robot_programs import program
from stitch.errors import InputError
from stitch.plugins.intake.folder_files import find_folder_files
from stitch.plugins.intake.layouts import possible_layouts
from stitch.plugins.intake.raw_poses import is_program, program_poses, read_lists, read_raw_poses
from stitch.plugins.intake.readings import readings

POSE_OF_ROS = """  position:
    x: 0.5
    y: -0.25
    z: 0.75
  orientation:
    x: 0.0
    y: 0.6
    z: 0.0
    w: 0.8
"""
# github.com/zivid/zivid-python-samples, robotTransform.yaml: OpenCV's FileStorage.
OPENCV = """%YAML:1.0
---
PoseState: !!opencv-matrix
   rows: 4
   cols: 4
   dt: d
   data: [ 9.9670000000000003e-01, -4.0399999999999998e-02,
       6.9900000000000004e-02, 5.6950000000000000e+02,
       2.0799999999999999e-02, 9.6519999999999995e-01,
       2.6060000000000000e-01, 3.1769999999999999e+02,
       -7.8000000000000000e-02, -2.5829999999999997e-01,
       9.6289999999999998e-01, 5.6929999999999995e+02, 0., 0., 0., 1. ]
"""
# Zivid's SDK saves a Matrix4x4 like this, as robot_pose_1.yaml … of its ROS driver.
ZIVID = """__version__:
  serializer: 1
  data: 1
FloatMatrix:
  Data:
    [
      [0.9967, -0.0404, 0.0699, 569.5],
      [0.0208, 0.9652, 0.2606, 317.7],
      [-0.0780, -0.2583, 0.9629, 569.3],
      [0, 0, 0, 1],
    ]
"""
# ros2 topic echo /tf
TF = """transforms:
- header:
    stamp:
      sec: 1757021880
    frame_id: base
  child_frame_id: tool0
  transform:
    translation:
      x: 0.5
      y: -0.25
      z: 0.75
    rotation:
      x: 0.0
      y: 0.6
      z: 0.0
      w: 0.8
---
transforms:
- header:
    stamp:
      sec: 1757021881
    frame_id: base
  child_frame_id: tool0
  transform:
    translation: {x: 0.5, y: -0.25, z: 0.5}
    rotation: {x: 0.6, y: 0.0, z: 0.0, w: 0.8}
"""
# github.com/Shiyu-Xing/RegHEC, RobotPoses.dat: angles first, in rad, a comma at the end.
REGHEC = """-2.620834,-0.519060,-2.473713,111.227938,-331.951396,317.520474,
-2.708615,-0.418518,-2.414003,114.687198,-358.734326,360.941072,
-2.979087,-0.752766,-2.269592,206.928588,-355.445190,317.091649,
"""
# Mech-Vision: x, y, z in m and a quaternion, w first (community.mech-mind.com/t/topic/1907).
MECH_MIND = "[[0.5, -0.25, 0.75, 0.8, 0, 0.6, 0], [0.5, -0.25, 0.5, 0.8, 0.6, 0, 0]]"


def read(tmp_path, name, text):
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    return read_raw_poses([file])


def only(raw, **stated):
    (layout,) = possible_layouts(raw)
    (reading,) = readings(layout, **stated)
    return reading


@pytest.mark.parametrize(("name", "text"), [("opencv.yaml", OPENCV), ("robot_pose_1.yaml", ZIVID)])
def test_matrices_of_zivid(tmp_path, name, text):
    reading = only(read(tmp_path, name, text))
    assert reading.rotation == "matrix"
    assert np.allclose(reading.T[0][0], [0.9967, -0.0404, 0.0699, 569.5], atol=1e-3)


def test_one_file_for_each_pose_in_the_order_of_their_numbers(tmp_path):
    (tmp_path / "poses").mkdir()
    (tmp_path / "scan.xyz").write_text("0 0 1\n", encoding="utf-8")
    for i in (1, 2, 10):
        (tmp_path / "poses" / f"robot_pose_{i}.yaml").write_text(ZIVID.replace("569.5", str(i)), encoding="utf-8")
    raw = read_raw_poses(find_folder_files(tmp_path, tmp_path / "poses").poses)
    assert only(raw).T[:, 0, 3].tolist() == [1, 2, 10]
    assert [labels[0] for labels in raw.labels] == ["robot_pose_1", "robot_pose_2", "robot_pose_10"]


def test_ros_transforms(tmp_path):
    reading = only(read(tmp_path, "tf.yaml", TF))
    assert reading.rotation == "quaternion-xyzw"
    assert np.allclose(reading.T[:, :3, 3], [[0.5, -0.25, 0.75], [0.5, -0.25, 0.5]])
    assert np.allclose(reading.T[0, :3, :3], [[0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, 0.28]])


def test_messages_of_ros_keep_their_time(tmp_path):
    stamped = "header:\n  stamp:\n    sec: {}\n    nanosec: {}\n  frame_id: base\npose:\n" + POSE_OF_ROS
    raw = read(tmp_path, "poses.yaml", "---\n".join(stamped.format(1718099007 + i, 250000000) for i in range(2)))
    (layout,) = possible_layouts(raw)
    assert layout.rest["time_s"].tolist() == [1718099007.25, 1718099008.25]
    assert only(raw).T[0, :3, 3].tolist() == [0.5, -0.25, 0.75]


def test_times_since_1970_stand_before_poses_without_a_header(tmp_path):
    """A trajectory as the TUM RGB-D benchmark and evo write it."""
    rows = "1305031453.3741 0.5 -0.25 0.75 0 0.6 0 0.8\n1305031453.3842 0.5 -0.25 0.5 0 0.6 0 0.8\n"
    for head in ("", "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"):
        raw = read(tmp_path, "groundtruth.txt", head + rows)
        (layout,) = possible_layouts(raw)
        assert [next(iter(layout.rest.values()))[1]] == [1305031453.3842]
        assert layout.position[0].tolist() == [0.5, -0.25, 0.75] and layout.rotation[0].tolist() == [0, 0.6, 0, 0.8]


@pytest.mark.parametrize("brackets", ["p[{}]", "p [{}]", "[{}]", "({})"])
def test_poses_as_universal_robots_writes_them(tmp_path, brackets):
    raw = read(
        tmp_path, "tcp_0.txt", brackets.format("0.7986999, -0.1417139, 0.7849780, -1.2629957, 0.69, -0.63") + "\n"
    )
    assert raw.numbers.tolist() == [[0.7986999, -0.1417139, 0.784978, -1.2629957, 0.69, -0.63]]


def test_a_column_called_p_keeps_its_name(tmp_path):
    raw = read(tmp_path, "poses.csv", "x,y,z,w[deg],p[deg],r[deg]\n" + "1,2,3,4,5,6\n" * 2)
    assert raw.header is not None and raw.header[4].startswith("p")


def test_reghec_says_by_its_sizes_that_angles_come_first_in_radians(tmp_path):
    (layout,) = possible_layouts(read(tmp_path, "RobotPoses.dat", REGHEC))
    assert layout.position[0].tolist() == [111.227938, -331.951396, 317.520474]
    assert {r.angle_unit for r in readings(layout)} == {"rad", "deg"}


def test_mech_mind_quaternion_may_be_of_either_order_until_somebody_says(tmp_path):
    raw = read(tmp_path, "poses.json", MECH_MIND)
    (layout,) = possible_layouts(raw)
    assert [r.rotation for r in readings(layout)] == ["quaternion-xyzw", "quaternion-wxyz"]
    assert np.allclose(only(raw, rotation="quaternion-wxyz").T[0, :3, 0], [0.28, 0, -0.96])


@pytest.mark.parametrize("order", ["rows", "columns"])
def test_matrices_in_text_json_yaml_numpy_and_matlab(tmp_path, order):
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.eye(3)).as_matrix()
    T[:, :3, 3] = [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    written = T if order == "rows" else T.transpose(0, 2, 1)
    blocks = "\n\n".join("\n".join(" ".join(f"{x:.9f}" for x in row) for row in M) for M in written)
    (tmp_path / "blocks.txt").write_text(blocks, encoding="utf-8")
    (tmp_path / "lists.json").write_text(json.dumps({"poses": written.tolist()}), encoding="utf-8")
    (tmp_path / "named.json").write_text(
        json.dumps({f"v{i}": M.tolist() for i, M in enumerate(written)}), encoding="utf-8"
    )
    dashes = "".join(f"- - {row[0].tolist()}\n" + "".join(f"  - {r.tolist()}\n" for r in row[1:]) for row in written)
    (tmp_path / "dashes.yml").write_text(dashes, encoding="utf-8")
    np.save(tmp_path / "all.npy", written)
    np.savetxt(tmp_path / "flat.csv", written.reshape(3, 16), delimiter=";")
    # MATLAB counts views last, and people keep their arrays in structures.
    savemat(tmp_path / "matlab.mat", {"poses": written.transpose(1, 2, 0)})
    savemat(tmp_path / "structure.mat", {"robot": {"name": "cell 3", "T": written.transpose(1, 2, 0)}})
    files = (
        "blocks.txt",
        "lists.json",
        "named.json",
        "dashes.yml",
        "all.npy",
        "flat.csv",
        "matlab.mat",
        "structure.mat",
    )
    for name in files:
        assert np.allclose(only(read_raw_poses([tmp_path / name])).T, T), name


def test_three_by_four_and_rotations_apart(tmp_path):
    R = Rotation.from_rotvec([[0.3, -0.2, 0.9], [0.1, 0.2, -0.4]]).as_matrix()
    t = np.array([[1.0, 2, 3], [4, 5, 6]])
    np.savetxt(tmp_path / "kitti.txt", np.concatenate([R, t[:, :, None]], axis=2).reshape(2, 12))
    assert np.allclose(only(read_raw_poses([tmp_path / "kitti.txt"])).T[:, :3, 3], t)
    np.savetxt(tmp_path / "apart.txt", np.hstack([R.reshape(2, 9), t]))
    (layout,) = possible_layouts(read_raw_poses([tmp_path / "apart.txt"]))
    by_rows, by_columns = readings(layout)
    assert np.allclose(by_rows.T[:, :3, :3], R) and np.allclose(by_columns.T[:, :3, :3], R.transpose(0, 2, 1))


HEADERS = {
    "X [mm];Y [mm];Z [mm];A;B;C": (None, "mm", None),
    "x_m,y_m,z_m,qw,qx,qy,qz": ("quaternion-xyzw", "m", None),
    "q1,q2,q3,q4,x,y,z": ("quaternion-wxyz", None, None),
    "X,Y,Z,W,P,R": ("xyz-extrinsic", None, None),
    "tcp.position.x tcp.position.y tcp.position.z roll_deg pitch_deg yaw_deg": ("xyz-extrinsic", None, "deg"),
    "rx(rad),ry(rad),rz(rad),px,py,pz": (None, None, "rad"),
}


@pytest.mark.parametrize("header", HEADERS)
def test_names_of_columns_tell_what_they_can(tmp_path, header):
    count = len(header.replace(";", ",").replace(" [", "[").replace(",", " ").split())
    row = [0.5] * 4 + [0.0] * (count - 4)
    separator = next(s for s in ";, " if s in header)
    if "qw" in header:
        row = [0.1, 0.2, 0.3, 1, 0, 0, 0]
    elif "q1" in header:
        row = [1, 0, 0, 0, 0.1, 0.2, 0.3]
    text = header + "\n" + "\n".join(separator.join(map(str, row)) for _ in range(3))
    (layout,) = possible_layouts(read(tmp_path, "t.csv", text))
    assert (layout.convention, layout.length_unit, layout.angle_unit) == HEADERS[header]
    if header[0] == "q" or "qw" in header:
        assert np.allclose(readings(layout)[0].T[:, :3, :3], np.eye(3))
        assert np.allclose(layout.position, [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.json", "{", "not valid JSON"),
        ("a.json", "[1, 2]", "holds no poses"),
        ("a.yaml", "a: [1, 2", "bracket"),
        ("a.yaml", "a:\n    - 1\n  b: 2\n", "no YAML that is known"),
        ("a.yaml", "a: 1\nb: &x [1, 2]\nc: *x\n", "line 3: refers to what stands elsewhere"),
        ("a.yaml", "a: 1\n? [1, 2]\n: 3\n", "line 2: a key is no word"),
        ("a.yaml", "a:\n  b: \t1\n\tc: 2\n", "line 3: .* tab"),
        ("a.yaml", "ä: 1\nb: \1", "line 2: .*control characters"),
        ("a.yaml", "a: !!python/object/apply:os.getcwd []\n", "holds no poses"),
        pytest.param("a.yaml", "[" * 100_000, "line 1: nested too deeply", id="a-hundred-thousand-lists"),
        ("a.csv", "a,b,c,d,e\n1,2,3,4,5\n", "--columns"),
        ("a.csv", "1,2,3,4,5,6,0.5\n2,3,4,5,6,7,0.5\n", "--columns"),
    ],
)
def test_what_holds_no_poses_is_refused(tmp_path, name, text, told):
    with pytest.raises(InputError, match=told):
        possible_layouts(read(tmp_path, name, text))


POSES = [np.array([[0.0, -1, 0, 900 + 10 * i], [1, 0, 0, 20], [0, 0, 1, 700], [0, 0, 0, 1]]) for i in range(4)]
DATA = "DEFDAT WORK\n" + "".join(
    f"DECL E6POS XP{i + 1}={{X {900 + 10 * i},Y 20,Z 700,A 90,B 0,C 0,S 2,T 35,E1 0}}\n" for i in range(4)
)
MOTIONS = (
    "DEF WORK()\nPTP {A1 0,A2 -90,A3 90,A4 0,A5 0,A6 0}\n" + "".join(f"LIN XP{i}\n" for i in (1, 2, 3, 4)) + "END\n"
)


@pytest.fixture
def folder(tmp_path):
    for i in range(4):
        np.savetxt(tmp_path / f"scan_{i + 1}.xyz", np.full((500, 3), i + 1.0))
    (tmp_path / "work.dat").write_text(DATA)
    return tmp_path


def test_the_program_is_read_and_not_its_points_beside_it(folder):
    assert is_program(folder / "work.dat") and find_folder_files(folder).poses == (folder / "work.dat",)
    (folder / "work.src").write_text(MOTIONS)
    assert find_folder_files(folder).poses == (folder / "work.src",)
    for file in ("work.dat", "work.src"):
        raw = program_poses(folder / file)
        places = raw.numbers[:, [raw.header.index(axis) for axis in "xyz"]]
        assert np.allclose(places, [T[:3, 3] for T in POSES])
        assert [texts[0] for texts in raw.labels] == ["XP1", "XP2", "XP3", "XP4"]


def test_joint_targets_without_a_pose_are_left_out_and_said(tmp_path):
    for controller, suffix in (("kuka", ".src"), ("ur", ".script"), ("abb", ".mod")):
        file = tmp_path / f"work{suffix}"
        file.write_text(program(controller, [np.zeros(6)], POSES))
        raw = program_poses(file)
        assert len(raw.numbers) == 4 and "1 without a pose left out" in raw.words


def test_a_table_may_end_in_dat(tmp_path):
    (tmp_path / "poses.dat").write_text("1,2,3,4,5,6\n2,3,4,5,6,7\n")
    assert not is_program(tmp_path / "poses.dat") and len(read_raw_poses([tmp_path / "poses.dat"]).numbers) == 2


def test_what_the_camera_wrote_beside_the_poses_is_no_table_of_poses(tmp_path):
    """Neither file says in its name what it holds."""
    for i in range(3):
        np.savetxt(tmp_path / f"scan_{i + 1}.xyz", np.full((500, 3), i + 1.0))
    (tmp_path / "camera_info.yaml").write_text(
        "height: 480\nwidth: 640\nk: [600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0]\n"
        "r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
    )
    (tmp_path / "remarks.txt").write_text("3 scans, gripper new, 22.5 degrees in the hall\n")
    rows = "".join(f"{800 + i} 20 700 0.1 0.2 {0.3 * i}\n" for i in range(3))
    (tmp_path / "run7.txt").write_text(rows)
    assert find_folder_files(tmp_path).poses == (tmp_path / "run7.txt",)


@pytest.mark.parametrize(("name", "factor"), [("Angle", 1.0), ("angle_deg", 180 / np.pi)])
def test_an_axis_and_an_angle_are_a_vector_of_rotation(tmp_path, name, factor):
    R = Rotation.from_rotvec([[0.3, -0.8, 1.9], [-1.2, 0.4, 0.7]])
    turns = [np.linalg.norm(vector) for vector in R.as_rotvec()]
    rows = [
        {"Rotation": {name: angle * factor, "Axis": (vector / angle).tolist()}, "Translation": [500.0, 200.0, 700.0]}
        for vector, angle in zip(R.as_rotvec(), turns, strict=True)
    ]
    reading = only(read(tmp_path, "poses.json", json.dumps({"Transformations": rows})))
    assert reading.rotation == "rotation-vector" and np.allclose(reading.T[:, :3, :3], R.as_matrix())


def test_the_header_of_euroc_names_a_quaternion(tmp_path):
    names = ["p_RS_R_x [m]", "p_RS_R_y [m]", "p_RS_R_z [m]", *(f"q_RS_{axis} []" for axis in "wxyz")]
    header = f"#timestamp [ns], {', '.join([*names, 'v_RS_R_x [m s^-1]'])}"
    text = (
        f"{header}\n1403636580838555648,0.5,0.2,0.7,0.8,0.6,0,0,0.1\n1403636589962012437,0.6,0.2,0.7,0.8,0,0.6,0,0.1\n"
    )
    reading = only(read(tmp_path, "data.csv", text))
    assert np.allclose(reading.T[0, :3, :3], Rotation.from_quat([0.6, 0, 0, 0.8]).as_matrix())
    assert reading.layout.length_unit == "m" and np.allclose(reading.T[0, :3, 3], [0.5, 0.2, 0.7])


def test_one_angle_beside_a_position_turns_about_z(tmp_path):
    reading = only(read(tmp_path, "scara.csv", "Nr;X;Y;Z;U\n1;843.9;-26.1;737.1;90\n2;676.8;206.9;725.0;-60\n"))
    assert np.allclose(reading.T[0, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])


JBI = """/JOB
//POS
///NPOS 3,0,0,0,0,0
///POSTYPE ROBOT
///RECTAN
C00000=540.401,210.184,711.688,-143.2731,26.7136,-164.1689
C00001=690.419,208.998,764.912,164.0445,21.6702,172.0475
C00002=690.638,110.320,744.290,154.1,20.1,171.2
//INST
NOP
MOVL C00000 V=50.0
"""


def test_rows_of_numbers_within_a_text_are_read_with_their_names(tmp_path):
    raw = read(tmp_path, "scan.JBI", JBI)
    assert raw.numbers.shape == (3, 6) and raw.labels[2] == ("C00002",)


def test_a_last_row_cut_short_is_left_out_by_its_line(tmp_path):
    rows = [f"{i},0.5,0.25,0.6,0,0,0.8" for i in range(4)]
    raw = read(tmp_path, "poses.csv", "\n".join(["x,y,z,qx,qy,qz,qw", *rows, "4,0.5,0.2"]) + "\n")
    assert raw.numbers.shape == (4, 7) and "line 6 is cut short and left out" in raw.words
    with pytest.raises(InputError, match="line 3: 3 cells"):
        read(tmp_path, "poses.csv", "\n".join(["x,y,z,qx,qy,qz,qw", rows[0], "4,0.5,0.2", *rows[1:]]) + "\n")


def test_marks_for_thousands_are_refused_by_name(tmp_path):
    text = "X;Y;Z;A;B;C\n1.540,401;210,184;711,688;-143,27;26,71;-164,16\n690,6;110,3;744,2;154,1;20,1;171,2\n"
    with pytest.raises(InputError, match=r"line 2: '1.540,401' has marks for thousands"):
        read(tmp_path, "poses.csv", text)


def test_names_that_differ_in_more_than_a_number_are_lists_of_their_own(tmp_path):
    T = np.eye(4).ravel().tolist()
    document = {f"{name}_{i}": [*T[:3], float(i), *T[4:]] for i in range(3) for name in ("gripper2base", "target2cam")}
    (tmp_path / "both.json").write_text(json.dumps(document))
    parts = {raw.part: len(raw.numbers) for raw in read_lists(tmp_path / "both.json")}
    assert parts["gripper2base"] == parts["target2cam"] == 3


def test_children_of_elements_of_xml_are_numbers_by_their_names(tmp_path):
    rows = "".join(f"<pose name='s{i}'><x>{i}</x><y>2</y><z>3</z><q>0 0.6 0 0.8</q></pose>" for i in range(3))
    raw = read(tmp_path, "poses.xml", f"<?xml version='1.0'?><poses>{rows}</poses>")
    assert raw.numbers.shape == (3, 7) and raw.labels[1] == ("s1",)


def test_rotations_and_positions_in_lists_of_their_own_are_one_list(tmp_path):
    R = Rotation.random(4, np.random.default_rng(3)).as_matrix()
    t = np.arange(12.0).reshape(4, 3)
    np.savez(tmp_path / "calib.npz", R_gripper2base=R, t_gripper2base=t[:, :, None])
    joined = read_lists(tmp_path / "calib.npz")[0]
    assert joined.part == "R_gripper2base+t_gripper2base"
    assert np.array_equal(joined.numbers, np.hstack([R.reshape(4, 9), t]))


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_an_axis_and_an_angle_in_a_table_are_a_vector_of_rotation(tmp_path, unit):
    vectors = Rotation.random(4, np.random.default_rng(4)).as_rotvec()
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    shown = np.degrees(angle) if unit == "deg" else angle
    rows = np.hstack([np.arange(12.0).reshape(4, 3), vectors / angle, shown])
    head = f"x,y,z,axis_x,axis_y,axis_z,angle_{unit}"
    np.savetxt(tmp_path / "t.csv", rows, delimiter=",", header=head, comments="", fmt="%.12f")
    raw = read_lists(tmp_path / "t.csv")[0]
    assert raw.header[-3:] == ("rvx [rad]", "rvy [rad]", "rvz [rad]") and np.allclose(raw.numbers[:, 3:], vectors)


def test_matlabs_cells_and_arrays_of_structs_are_lists(tmp_path):
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = np.arange(9.0).reshape(3, 3)
    cells = np.empty(3, object)
    cells[:] = list(T)
    savemat(tmp_path / "cells.mat", {"Hg": cells})
    assert np.array_equal(read_lists(tmp_path / "cells.mat")[0].numbers, T.reshape(3, 16))
    savemat(tmp_path / "structs.mat", {"pose": np.array([{"R": M[:3, :3], "t": M[:3, 3]} for M in T])})
    assert read_lists(tmp_path / "structs.mat")[0].numbers[:, 9:].tolist() == T[:, :3, 3].tolist()


def test_the_pose_of_3dtk_is_mirrored_as_its_scans_are(tmp_path):
    """R = Rx Ry Rz of angles in degrees, positions in cm, in a left-handed frame: with z the other way round S T S."""
    S = np.diag([1.0, 1.0, -1.0])
    angles, position = np.array([20.0, -35.0, 110.0]), np.array([12.5, -3.0, 40.0])
    for i in range(3):
        (tmp_path / f"scan{i:03d}.3d").write_text("1 2 3\n")
        (tmp_path / f"scan{i:03d}.pose").write_text("12.5 -3 40\n20 -35 110\n")
    raw = read_raw_poses(sorted(tmp_path.glob("*.pose")))
    layout = possible_layouts(raw)[0]
    assert layout.length_unit == "cm"
    T = readings(layout)[0].T[0]
    turns = [
        Rotation.from_euler(axis, angle, degrees=True).as_matrix() for axis, angle in zip("xyz", angles, strict=True)
    ]
    assert np.allclose(T[:3, :3], S @ turns[0] @ turns[1] @ turns[2] @ S) and np.allclose(T[:3, 3], S @ position)


def test_a_position_above_its_angles_is_a_pose_a_file(tmp_path):
    for i in range(3):
        (tmp_path / f"p{i}.txt").write_text(f"{400 + i} -300 {500 + 9 * i}\n10.5 {20 + 7 * i} -130\n")
    raw = read_raw_poses(sorted(tmp_path.glob("*.txt")))
    assert raw.numbers.shape == (3, 6) and possible_layouts(raw)[0].words.startswith("columns 1 to 3 are the position")
