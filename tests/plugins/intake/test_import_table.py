"""`stitch import` of tables: what the file does not say is asked for by its flag."""

import csv
import io

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.command_line import ended

SIX = "view;cloud;x;y;z;rx;ry;rz\nv1;a.ply;812,4;-31;655,2;0,5;-0,25;1,5\nv2;b.ply;800;-30;650;0,6;-0,2;1,4\n"
JOINTS = "j1 j2 j3 j4 j5 j6\n0.1 0.2 0.3 0.4 0.5 0.6\n0.2 0.2 0.3 0.4 0.5 0.6\n"


@pytest.fixture
def imported(tmp_path):
    """Rows of a table that is imported, and what is said beside them."""

    def call(name, text, *flags, code=0):
        (tmp_path / name).write_text(text, encoding="utf-8")
        out, err = ended("import", tmp_path / name, *flags, code=code)
        return list(csv.DictReader(io.StringIO(out))), err

    return call


def test_a_table_with_what_the_file_does_not_say(imported):
    rows, _ = imported("t.txt", SIX, "--rotation", "zyx-intrinsic", "--angles", "rad", "--unit", "m")
    assert [row["view"] for row in rows] == ["v1", "v2"] and rows[0]["cloud"] == "a.ply"
    assert [float(rows[0][axis]) for axis in "xyz"] == [0.8124, -0.031, 0.6552]
    q = Rotation.from_quat([float(rows[0][name]) for name in ("qx", "qy", "qz", "qw")])
    # Rz(0.5)·Ry(−0.25)·Rx(1.5), written out.
    expected = [Rotation.from_rotvec(v).as_matrix() for v in ([0, 0, 0.5], [0, -0.25, 0], [1.5, 0, 0])]
    assert np.allclose(q.as_matrix(), expected[0] @ expected[1] @ expected[2], atol=1e-8)


def test_poses_of_the_base_in_the_flange_are_inverted(imported):
    text = "1,0,0,5,0,1,0,6,0,0,1,7,0,0,0,1\n0,-1,0,500,1,0,0,600,0,0,1,700,0,0,0,1\n"
    rows, _ = imported("t.csv", text, "--inverse", "--file-unit", "mm")
    assert [float(rows[1][axis]) for axis in "xyz"] == [-600, 500, -700]


def test_times_and_temperatures_come_along(imported):
    text = "time,x,y,z,qx,qy,qz,qw,scanner temperature [C]\n7.5,100,0,500,0,0,0,1,20.5\n9,100,0,510,0,0,0,1,21\n"
    rows, _ = imported("t.txt", text)
    assert [row["time_s"] for row in rows] == ["0", "1.5"]
    assert [row["scanner_temperature_c"] for row in rows] == ["20.5", "21"]


def test_times_of_day_come_along(imported):
    text = "view,time,x,y,z,qx,qy,qz,qw\na,09:59:58.5,100,0,500,0,0,0,1\nb,10:00:01,100,0,510,0,0,0,1\n"
    rows, _ = imported("t.txt", text)
    assert [row["time_s"] for row in rows] == ["0", "2.5"] and [row["view"] for row in rows] == ["a", "b"]
    rows, said = imported("t.txt", text.replace("09:59:58.5", "11:00:00"))
    assert "time_s" not in rows[0] and "times of day run backwards" in said


def test_joint_angles(imported):
    rows, _ = imported("t.txt", JOINTS, "--angles", "rad")
    assert "x" not in rows[0]
    assert np.allclose([float(rows[1][f"j{i}_deg"]) for i in range(1, 7)], np.degrees([0.2, 0.2, 0.3, 0.4, 0.5, 0.6]))


@pytest.mark.parametrize(
    ("name", "text", "flags", "told"),
    [
        ("t.txt", SIX, (), "--rotation"),
        ("t.txt", SIX, ("--rotation", "xyz-extrinsic"), "--angles"),
        (
            "t.txt",
            SIX.replace("812,4", "48").replace("800", "47").replace("655,2", "2").replace("650", "2"),
            ("--rotation", "xyz-extrinsic", "--angles", "rad"),
            "--file-unit",
        ),
        ("t.txt", JOINTS, (), "--angles"),
        ("t.dat", "0.1,0.2,0.3,0.4,0.5,0.6\n0.2,0.2,0.3,0.4,0.5,0.6\n", (), "--columns"),
        ("t.json", "[[1, 2, 3]]", (), "no poses"),
        ("t.txt", SIX, ("--file-unit", "feet"), "--file-unit feet"),
    ],
)
def test_what_the_file_does_not_say_is_asked_for_by_its_flag(imported, name, text, flags, told):
    rows, err = imported(name, text, *flags, code=2)
    assert told in err and not rows and len(err.strip().splitlines()) == 1


def test_programs_and_trackers_keep_their_readers(imported):
    rows, err = imported("t.csv", "name,x,y,z\na,1,2,3\nb,2,3,4\n")
    assert rows[0]["target"] == "a" and "points.csv" in err


def test_a_tracker_probe_with_decimal_commas(imported):
    text = "Name;X [m];Y [m];Z [m];Q0;Q1;Q2;Q3\nm1;1,5;-2,25;0,125;0,7071068;0;0,7071068;0\n"
    rows, err = imported("tmac.csv", text)
    assert "frames.csv" in err and rows[0]["view"] == "m1"
    assert [float(rows[0][c]) for c in ("x", "y", "z")] == pytest.approx([1500, -2250, 125])
    q = [float(rows[0][c]) for c in ("qx", "qy", "qz", "qw")]
    assert q == pytest.approx([0, np.sqrt(0.5), 0, np.sqrt(0.5)], abs=1e-7)


def test_angles_of_a_tracker_turn_about_fixed_axes(imported):
    rows, _ = imported("probe.csv", "id,x,y,z,Rx (deg),Ry (deg),Rz (deg)\na,1,2,3,10,20,30\nb,1,2,4,10,20,30\n")
    turn = Rotation.from_quat([float(rows[0][c]) for c in ("qx", "qy", "qz", "qw")]).as_matrix()
    turns = [Rotation.from_rotvec(np.radians(v)).as_matrix() for v in ([0, 0, 30], [0, 20, 0], [10, 0, 0])]
    assert np.allclose(turn, turns[0] @ turns[1] @ turns[2], atol=1e-8)


def test_reflectors_begin_a_view_where_a_name_comes_again(imported):
    rows, err = imported("points.csv", "Point,X,Y,Z\nT1,1,2,3\nT2,4,5,6\nT1,1,2,4\n")
    assert "points.csv" in err
    assert [(row["view"], row["target"], float(row["z"])) for row in rows] == [
        ("v1", "T1", 3),
        ("v1", "T2", 6),
        ("v2", "T1", 4),
    ]


def test_a_recording_of_universal_robots_in_metres(imported):
    header = " ".join(["timestamp", *(f"actual_q_{i}" for i in range(6)), *(f"actual_TCP_pose_{i}" for i in range(6))])
    rows = "\n0.008 0 0 0 0 0 1 0.1 0.2 0.3 0 0 0\n0.016 0 0 0 0 0 2 0.4 0.5 0.6 0 0 0.5\n"
    table, _ = imported("record.csv", header + rows, "--unit", "m", "--angles", "rad")
    assert [float(table[1][c]) for c in "xyz"] == pytest.approx([0.4, 0.5, 0.6])
    assert float(table[1]["j6_deg"]) == pytest.approx(np.degrees(2))
    assert float(table[1]["qz"]) == pytest.approx(np.sin(0.25))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x,y,z\n1,2,oops\n3,4,5\n", "oops"),
        ("x,y,z,qw,qx,qy,qz\n1,2,3,1,1,0,0\n2,2,3,1,1,0,0\n", "quaternion of length 1.41"),
        ("x,y,z,rx,ry,rz\n1,2,3,0,0,1\n2,2,3,0,0,1\n", "may be degrees or a rotation vector"),
    ],
)
def test_exports_that_do_not_say_what_they_hold_are_refused(imported, text, told):
    rows, err = imported("a.csv", text, code=2)
    assert told in err and not rows
