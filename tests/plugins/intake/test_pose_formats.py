"""Texts of robots and reconstruction programs, typed after their manuals, hold the poses that they were written of."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.plugins.intake.layouts import possible_layouts
from stitch.plugins.intake.pose_formats import read_pose_text
from stitch.plugins.intake.raw_poses import read_raw_poses
from stitch.plugins.intake.readings import readings

R = Rotation.from_rotvec([[0.3, -0.8, 1.9], [-1.2, 0.4, 0.7], [2.0, 0.1, -0.5]])
P = np.array([[837.754, 184.587, 675.455], [703.404, -305.129, 659.081], [-58.119, 271.242, 1662.384]])  # mm
T = np.tile(np.eye(4), (3, 1, 1))
T[:, :3, :3], T[:, :3, 3] = R.as_matrix(), P
INVERSE = np.linalg.inv(T)


def fill(line, *columns):
    return "\n".join(line.format(*row, i=i) for i, row in enumerate(np.hstack(columns)))


ABC, WPR = R.as_euler("ZYX", degrees=True), R.as_euler("xyz", degrees=True)
Q, WXYZ = R.as_quat(), R.as_quat()[:, [3, 0, 1, 2]]
COLMAP_Q = Rotation.from_matrix(INVERSE[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
TEXTS = {
    "E6POS": fill(
        "{i}: {{E6POS: X {:.9f}, Y {:.9f}, Z {:.9f}, A {:.9f}, B {:.9f}, C {:.9f}, S 2, T 35, E1 0.0}}", P, ABC
    ),
    "POS_ACT": fill(
        "2026-03-0{i} 14:02:11 $POS_ACT={{X {:.9f},Y {:.9f},Z {:.9f},A {:.9f},B {:.9f},C {:.9f},S 2,T 35}}", P, ABC
    ),
    "POS_ACT over lines": fill(
        "P{i}\n$POS_ACT.X = {:.9f}\nX = {:.9f}\n  Y = {:.9f}\n  Z = {:.9f}\n A = {:.9f}\n B = {:.9f}\n C = {:.9f}",
        P[:, :1],
        P,
        ABC,
    ),
    "FANUC": fill(
        "P[{i}]{{\n GP1:\n  UF : 0, UT : 1, CONFIG : 'N U T, 0, 0, 0',\n  X = {:.9f} mm, Y = {:.9f} mm, Z = {:.9f} mm,\n"
        "  W = {:.9f} deg, P = {:.9f} deg, R = {:.9f} deg\n}};",
        P,
        WPR,
    ),
    "FANUC page": fill(
        "PR[{i}] UF:F UT:F CONF:NUT 000\nX {:.9f} mm W {:.9f} deg\nY {:.9f} mm P {:.9f} deg\nZ {:.9f} mm R {:.9f} deg",
        P[:, :1],
        WPR[:, :1],
        P[:, 1:2],
        WPR[:, 1:2],
        P[:, 2:],
        WPR[:, 2:],
    ),
    "ABB": fill(
        "p{i}0 [[{:.9f},{:.9f},{:.9f}],[{:.9f},{:.9f},{:.9f},{:.9f}],[0,-1,0,1],[9E+9,9E+9,9E+9,9E+9,9E+9,9E+9]]",
        P,
        WXYZ,
    ),
    "UR": fill(
        "10:0{i}:02 INFO: get_actual_tcp_pose() -> p[{:.12f}, {:.12f}, {:.12f}, {:.9f}, {:.9f}, {:.9f}]",
        P / 1e3,
        R.as_rotvec(),
    ),
    "tf_echo": fill(
        "At time {i}.5\n- Translation: [{:.12f}, {:.12f}, {:.12f}]\n- Rotation: in Quaternion [{:.9f}, {:.9f}, {:.9f}, {:.9f}]\n"
        "            in RPY (radian) [0.1, 0.2, 0.3]\n            in RPY (degree) [5.7, 11.5, 17.2]",
        P / 1e3,
        Q,
    ),
    "trajectory.log": fill(
        "{i} {i} 3\n{:.9f} {:.9f} {:.9f} {:.9f}\n{:.9f} {:.9f} {:.9f} {:.9f}\n{:.9f} {:.9f} {:.9f} {:.9f}\n0 0 0 1",
        T[:, :3].reshape(3, 12),
    ),
    "COLMAP": "# Image list with two lines of data per image:\n"
    + fill(
        "{i} {:.9f} {:.9f} {:.9f} {:.9f} {:.9f} {:.9f} {:.9f} 1 view_{i}.png\n1.5 2.5 -1 3.5 4.5 7",
        COLMAP_Q,
        INVERSE[:, :3, 3],
    ),
}


def poses(raw):
    """(V, 4, 4) mm of what names of columns tell alone."""
    (layout,) = possible_layouts(raw)
    reading = readings(layout)[0]
    out = np.array(reading.T)
    out[:, :3, 3] *= 1e3 if layout.length_unit == "m" else 1.0
    return out


@pytest.mark.parametrize("kind", TEXTS)
def test_a_text_gives_the_poses_that_it_was_written_of(tmp_path, kind):
    (tmp_path / "poses.log").write_text(TEXTS[kind] + "\n", encoding="utf-8")
    raw = read_raw_poses([tmp_path / "poses.log"])
    assert np.abs(poses(raw) - T).max() < 1e-4, raw.words


@pytest.mark.parametrize(
    ("kind", "labels"),
    [
        ("E6POS", [("0",), ("1",), ("2",)]),
        ("POS_ACT", [("2026-03-00",), ("2026-03-01",), ("2026-03-02",)]),
        ("ABB", [("p00",), ("p10",), ("p20",)]),
        ("UR", [("10:00:02",), ("10:01:02",), ("10:02:02",)]),
        ("trajectory.log", [("0",), ("1",), ("2",)]),
        ("COLMAP", [("view_0.png",), ("view_1.png",), ("view_2.png",)]),
    ],
)
def test_what_stands_beside_a_pose_names_it(kind, labels):
    ((rows, _),) = read_pose_text(TEXTS[kind]).values()
    assert [words for words, _ in rows] == labels


def test_a_name_behind_each_pose_belongs_to_it():
    text = "".join(f"X {x} Y {y} Z {z} RX 1 RY 2 RZ 3 -> scan_{i}.ply\n" for i, (x, y, z) in enumerate(P))
    ((rows, _),) = read_pose_text(text).values()
    assert [words for words, _ in rows] == [(f"scan_{i}.ply",) for i in range(3)]


HALCON = """# 3D POSE PARAMETERS: rotation and translation
f {code}
# Rotation angles [deg] or Rodriguez vector:
r {:.9f} {:.9f} {:.9f}
# Translation vector (x y z [m]):
t {:.12f} {:.12f} {:.12f}
"""


@pytest.mark.parametrize("code", [0, 1, 2, 4, 8])
def test_pose_files_of_halcon_in_every_representation(tmp_path, code):
    for i, pose in enumerate(INVERSE if code == 1 else T):
        turn, shift = Rotation.from_matrix(pose[:3, :3]), pose[:3, 3] / 1e3
        if code == 2:
            r = turn.as_euler("xyz", degrees=True)
        elif code == 4:
            axis = turn.as_rotvec() / turn.magnitude()
            r = axis * np.tan(turn.magnitude() / 2)
        else:
            r = turn.as_euler("XYZ", degrees=True)
        # R·(p − t) instead of R·p + t.
        shift = -turn.inv().apply(shift) if code == 8 else shift
        (tmp_path / f"pose_{i}.dat").write_text(HALCON.format(*r, *shift, code=code))
    raw = read_raw_poses(sorted(tmp_path.glob("*.dat")))
    assert np.abs(poses(raw) - T).max() < 1e-4


def test_nodes_of_a_pose_graph_are_poses_and_edges_are_none(tmp_path):
    graph = {"class_name": "PoseGraph", "edges": [{"transformation": np.eye(4).ravel().tolist()}] * 3}
    graph["nodes"] = [{"class_name": "PoseGraphNode", "pose": pose.T.ravel().tolist()} for pose in T]
    (tmp_path / "graph.json").write_text(json.dumps(graph))
    assert np.abs(poses(read_raw_poses([tmp_path / "graph.json"])) - T).max() < 1e-9


def test_cameras_of_open3d_hold_the_inverse(tmp_path):
    cameras = [{"extrinsic": pose.T.ravel().tolist(), "intrinsic": {"width": 640}} for pose in INVERSE]
    (tmp_path / "cameras.json").write_text(json.dumps({"class_name": "PinholeCameraTrajectory", "parameters": cameras}))
    assert np.abs(poses(read_raw_poses([tmp_path / "cameras.json"])) - T).max() < 1e-9


@pytest.mark.parametrize(
    "line",
    [
        "pose {i}: {}, {}, {}, {}, {}, {}",
        "P{i} {}; {}; {}; {}; {}; {}",
        "pose_{i}=[{}, {}, {}, {}, {}, {}]",
        "{}, {}, {}, {}, {}, {} scan_{i}.ply",
        "{} mm\t{}\t{}\t{}\t{}\t{}°",
        "scan {i} {} {} {} {} {} {}",
    ],
)
def test_the_first_number_of_a_row_is_never_lost_in_its_name(tmp_path, line):
    (tmp_path / "poses.txt").write_text(fill(line, P, WPR) + "\n", encoding="utf-8")
    raw = read_raw_poses([tmp_path / "poses.txt"])
    kept = {round(x, 6) for row in raw.numbers for x in row}
    assert {round(x, 6) for x in np.hstack([P, WPR]).ravel()} <= kept


@pytest.mark.parametrize("word", ["nan", "-inf", "null", "NaN"])
def test_a_row_without_a_pose_is_told_and_the_others_stay(tmp_path, word):
    rows = [",".join(map(str, row)) for row in np.hstack([P, Q])]
    (tmp_path / "poses.csv").write_text("\n".join([*rows, ",".join([word] * 7)]) + "\n")
    raw = read_raw_poses([tmp_path / "poses.csv"])
    assert raw.without_pose == {3} and np.abs(raw.numbers[:3] - np.hstack([P, Q])).max() < 1e-9
    matrices = ["\n".join(" ".join(map(str, row)) for row in pose) for pose in T]
    (tmp_path / "blocks.txt").write_text("\n\n".join([*matrices, "\n".join([f"{word} " * 4] * 4)]) + "\n")
    assert read_raw_poses([tmp_path / "blocks.txt"]).without_pose == {3}
    for i, matrix in enumerate([*matrices, "\n".join([f"{word} " * 4] * 4)]):
        (tmp_path / f"frame-{i}.pose.txt").write_text(matrix)
    assert read_raw_poses(sorted(tmp_path.glob("frame*"))).without_pose == {3}


def test_elements_of_xml_are_a_list_each(tmp_path):
    text = fill(
        '<Rob Type="KUKA"><RIst X="{:.9f}" Y="{:.9f}" Z="{:.9f}" A="{:.9f}" B="{:.9f}" C="{:.9f}"/>'
        '<AIPos A1="1" A2="2" A3="3" A4="4" A5="5" A6="6"/></Rob>',
        P,
        ABC,
    )
    lists = read_pose_text(text)
    assert list(lists) == ["RIst", "AIPos"] and lists["AIPos"][0][0][1]["j6 [deg]"] == 6.0
    (tmp_path / "log.xml").write_text(text)
    assert np.abs(poses(read_raw_poses([tmp_path / "log.xml"])) - T).max() < 1e-6


def test_a_matrix_below_a_heading_of_single_words_is_the_pose():
    text = "VERSION\n=\n1\n\nMATRIX\n=\n" + "\n".join("  ".join(map(str, row)) for row in T[0])
    ((rows, _),) = read_pose_text(text).values()
    assert np.allclose(list(rows[0][1].values()), T[0].ravel())


def test_the_word_next_to_a_pose_is_its_name():
    rows = ["# cell 3, 2024-03-11 10:00", *(f"scan_{i} p[0.{i}, 0.2, 0.3, 0.1, 0.2, 0.3]" for i in range(3))]
    ((found, _),) = read_pose_text("\n".join(rows)).values()
    assert [labels for labels, _ in found] == [("scan_0",), ("scan_1",), ("scan_2",)]


def test_the_conf_of_stanford_turns_by_the_inverse_of_its_quaternion(tmp_path):
    """As zipper and the alignments that people publish read it: p' = R(q)ᵀ p + t, and the camera is none of the scans."""
    rows = [
        f"bmesh bun{i:03d}.ply " + " ".join(f"{x:.9f}" for x in (*p, *q))
        for i, (p, q) in enumerate(zip(P, R.inv().as_quat(), strict=True))
    ]
    (tmp_path / "bun.conf").write_text("\n".join(["camera -0.01 -0.09 -0.7 0 0 0 1", *rows]))
    raw = read_raw_poses([tmp_path / "bun.conf"])
    assert [labels[0] for labels in raw.labels] == ["bun000.ply", "bun001.ply", "bun002.ply"]
    assert np.allclose(readings(possible_layouts(raw)[0])[0].T, T, atol=1e-6)
