"""Programs of four controllers, against rotations written out by hand; broken programs and tables."""

import csv
import io

import numpy as np
import pytest

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.plugins.intake.controllers.program import import_file
from stitch.plugins.intake.controllers.taught_points import fixed_xyz, quaternion_w_first, rotation_vector, zyx
from stitch.session.reading.robot_description import robot_from_dh
from stitch.session.reading.views_table import read_views
from tests.command_line import ended
from tests.plugins.intake.controllers.program_samples import ABB, FANUC, KUKA_DAT, KUKA_SRC, UR


def about(axis, degrees):
    """Elementary rotation matrices from cosines and sines."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def rows(tmp_path, name, text, **options):
    """Views as the session's own reader sees them, by name."""
    file = tmp_path / name
    file.write_text(text)
    imported = import_file(file, **options)
    views = tmp_path / "views.csv"
    views.write_text(imported.text)
    robot = None
    if "j1_deg" in imported.text:
        robot = robot_from_dh(
            "r", "standard", [{"a": 0, "alpha_deg": 90, "d": 100, "theta_deg": 0}] * 6, None, np.zeros(3), "mm"
        )
    return {row.view.name: row.view for row in read_views(views, robot)}, imported


def test_orientations_by_hand():
    assert fixed_xyz(np.array([1, 2, 3, 10, 20, 30.0]))[:3, :3] == pytest.approx(
        about("z", 30) @ about("y", 20) @ about("x", 10)
    )
    assert zyx(np.array([1, 2, 3, 10, 20, 30.0]))[:3, :3] == pytest.approx(
        about("z", 10) @ about("y", 20) @ about("x", 30)
    )
    half = np.sqrt(0.5)
    assert quaternion_w_first(np.array([0, 0, 0, half, 0, half, 0]))[:3, :3] == pytest.approx(about("y", 90))
    turn = rotation_vector(np.array([0.1, 0, 0, 0, 0, np.pi / 2]))
    assert turn[:3, :3] == pytest.approx(about("z", 90)) and turn[0, 3] == pytest.approx(100)
    flip = rotation_vector(np.array([0, 0, 0, np.pi * half, -np.pi * half, 0]))
    assert flip[:3, :3] == pytest.approx(np.array([[0, -1, 0], [-1, 0, 0], [0, 0, -1.0]]))


def test_fanuc(tmp_path):
    views, imported = rows(tmp_path, "SCAN1.LS", FANUC)
    T = views["above"].T_base_flange
    assert T[:3, 3] == pytest.approx([-195.8, 1363.305, 524.812])
    assert T[:3, :3] == pytest.approx(about("z", 20.366) @ about("y", -0.087) @ about("x", -179.111), abs=1e-8)
    assert np.degrees(views["P2"].joints) == pytest.approx([10, -20.5, 30, 0, -45, 90])
    assert "UF 1, UT 2" in imported.warnings[0]


def test_frame_and_tool_lead_to_the_flange(tmp_path):
    views, imported = rows(tmp_path, "S.ls", FANUC, frame="1000,0,0,0,0,90", tool="0,0,150,0,0,0")
    taught = frames.make(
        about("z", 20.366) @ about("y", -0.087) @ about("x", -179.111), np.array([-195.8, 1363.305, 524.812])
    )
    frame, tool = frames.make(about("z", 90), np.array([1000.0, 0, 0])), frames.make(np.eye(3), np.array([0, 0, 150.0]))
    assert views["above"].T_base_flange == pytest.approx(frame @ taught @ np.linalg.inv(tool), abs=1e-5)
    assert imported.warnings == ()


def test_kuka(tmp_path):
    views, _ = rows(tmp_path, "scan.dat", KUKA_DAT)
    T = views["XP1"].T_base_flange
    assert T[:3, 3] == pytest.approx([1025, -12.5, 1480])
    assert T[:3, :3] == pytest.approx(about("z", 10) @ about("y", 20) @ about("x", 30), abs=1e-8)
    assert np.degrees(views["XHOME"].joints) == pytest.approx([0, -90, 90, 0, 0, 15])
    views, _ = rows(tmp_path, "scan.src", KUKA_SRC)
    assert list(views) == ["XHOME", "XP1", "line6", "line7"]
    assert views["XP1"].T_base_flange == pytest.approx(T, abs=1e-6)
    assert np.degrees(views["line6"].joints) == pytest.approx([5, -80, 80, 0, 10, 0])
    assert views["line7"].T_base_flange[:3, :3] == pytest.approx(about("z", 90), abs=1e-8)


def test_points_of_several_tools_are_not_mixed(tmp_path):
    """A KUKA says tool and base in a point's FDAT, an ABB in the move."""
    second = KUKA_DAT.replace(
        "ENDDAT", "DECL E6POS XP2={X 1,Y 2,Z 3,A 0,B 0,C 0}\nDECL FDAT FP2={TOOL_NO 2,BASE_NO 0}\nENDDAT"
    )
    (tmp_path / "a.dat").write_text(second)
    with pytest.raises(InputError, match="a.dat line 7: XP2 is taught in TOOL 2, BASE 0, XP1 in TOOL 1, BASE 0"):
        import_file(tmp_path / "a.dat")
    (tmp_path / "b.dat").write_text(KUKA_DAT.replace("TOOL_NO 1", "TOOL_NO 0"))
    assert import_file(tmp_path / "b.dat").warnings == ()
    (tmp_path / "a.mod").write_text(ABB.replace("z10, tool0", "z10, gripper \\WObj:=table"))
    with pytest.raises(InputError, match="a.mod line 11: line11 is taught in gripper, table, p10 in tool0, wobj0"):
        import_file(tmp_path / "a.mod")
    # Of p20 and the array nobody says with which tool they are used.
    (tmp_path / "b.mod").write_text(ABB)
    assert "give --frame and --tool" in import_file(tmp_path / "b.mod").warnings[0]


def test_abb(tmp_path):
    views, imported = rows(tmp_path, "Scan.mod", ABB, unit="mm")
    assert list(views) == ["p10", "p20", "home", "many_1", "many_2", "line10", "line11"]
    assert views["p10"].T_base_flange == pytest.approx(
        frames.make(about("y", 90), np.array([600, -5.5, 800.0])), abs=1e-5
    )
    assert views["p20"].T_base_flange[:3, :3] == pytest.approx(about("x", 30), abs=1e-5)
    assert np.degrees(views["home"].joints) == pytest.approx([0, 10, -20, 30, -40, 50])
    assert np.degrees(views["line10"].joints) == pytest.approx([1, 2, 3, 4, 5, 6])
    assert views["line11"].T_base_flange[:3, :3] == pytest.approx(about("y", 180), abs=1e-8)
    assert "q1 = w" in imported.convention and "p" not in views


def test_ur_script(tmp_path):
    file = tmp_path / "scan.script"
    file.write_text(UR)
    table = list(csv.DictReader(io.StringIO(import_file(file).text)))
    assert [row["view"] for row in table] == ["Waypoint_1", "line8", "line9"]
    assert [float(table[0][c]) for c in "xyz"] == pytest.approx([-100, 200, 300])
    assert float(table[0]["j5_deg"]) == pytest.approx(np.degrees(-1.57))
    q = [float(table[1][c]) for c in ("qx", "qy", "qz", "qw")]
    assert q == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)], abs=1e-8)
    assert table[2]["x"] == "" and float(table[2]["j2_deg"]) == pytest.approx(np.degrees(-1.57))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.ls", FANUC.replace("1363.305", "********"), r"a.ls line 7: P\[1\] Y is '\*+'; teach the point"),
        ("a.ls", FANUC.split("/POS")[0], r"a.ls: no /POS section"),
        ("a.ls", FANUC.replace("UT : 2,\t\tC", "UT : 3,\t\tC").replace("J1=    10.000 deg", "X=1 mm,Y=2 mm,Z=3 mm,W=0 deg,P=0 deg,R=0 deg"),
         r"line 13: P2 is taught in UF 1, UT 2, above in UF 1, UT 3"),
        ("lone.src", KUKA_SRC, r"lone.src line 3: XHOME is declared nowhere; to fix: put lone.dat beside"),
        ("a.dat", KUKA_DAT.replace("A 10.0,B", "B"), r"a.dat line 4: XP1 has neither X, Y, Z, A, B, C nor A1"),
        ("a.mod", ABB.replace("0.965926", "0.5"), r"a.mod line 4: p20: quaternion of length"),
        ("a.mod", ABB.replace("[[600,-5.5,800]", "[[600,-5.5]"), r"a.mod line 3: p10 is no target"),
        ("a.script", "movel(p[x,0,0,0,0,0])\n", r"a.script line 1: the target is computed"),
        ("a.script", "movel(p[0,5,0,0,0,0,0])\n", r"a.script line 1: line1 has 7 numbers"),
        ("a.src", "LIN {X 1,5,Y 0,Z 0,A 0,B 0,C 0}\n", r"a.src line 1: line1 has '5' between its commas"),
        ("a.src", "LIN {X 1.5,Y 0,Z 0,A 0,B 0,C 0\n", r"a.src line 1: a brace stays open"),
        ("a.ls", FANUC.replace("-195.800", "-195,800"), r"a.ls line 7: P\[1\] has '-195,800'"),
        ("a.ls", "", r"empty"),
    ],
)  # fmt: skip
def test_bad_files_name_line_and_mend(name, text, message, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        import_file(tmp_path / name)


def test_bad_options_and_programs_without_points(tmp_path):
    (tmp_path / "p.ls").write_text(FANUC)
    with pytest.raises(InputError, match="--tool 1,2: to fix: write 6 numbers"):
        import_file(tmp_path / "p.ls", tool="1,2")
    with pytest.raises(InputError, match="--unit inch"):
        import_file(tmp_path / "p.ls", unit="inch")
    (tmp_path / "e.mod").write_text("MODULE a\nENDMODULE\n")
    with pytest.raises(NoResultError, match="no taught points"):
        import_file(tmp_path / "e.mod")


def test_command_writes_once(tmp_path):
    (tmp_path / "p.mod").write_text(ABB)
    target = tmp_path / "views.csv"
    assert "7 rows of views.csv" in ended("import", tmp_path / "p.mod", "-o", target).err
    assert "exists already" in ended("import", tmp_path / "p.mod", "-o", target, code=2).err
    assert target.read_text().startswith("view,j1_deg,")


def test_the_command_warns_of_the_program_and_not_of_the_table(tmp_path):
    program = tmp_path / "p.ls"
    program.write_text(FANUC)
    told = ended("import", program, "-o", tmp_path / "views.csv")
    assert f"stitch: {program}: poses are those of the tool" in told.err
