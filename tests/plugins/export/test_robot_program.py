"""Robot programs: targets moved and compensated, everything else to the letter.

Programs that drive to proposed views, read back by the readers of the controllers' own files.
"""

import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth import kinematics
from data_synth.arms import ARMS
from data_synth.fixtures.labelled_arm import flange, labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.fixtures.robot_programs import SUFFIXES, program
from data_synth.fixtures.run_folders import bare_run
from data_synth.fixtures.true_arm import drawn, true_flanges
from data_synth.write import robot_table
from stitch.effects import EFFECTS
from stitch.errors import InputError, NoResultError
from stitch.model.model import Term
from stitch.numerics import frames
from stitch.plugins.export.next_program import next_program
from stitch.plugins.export.robot_program import compensate_targets, compensated_program, compensated_texts
from stitch.plugins.intake.controllers.program import import_file, read_program
from stitch.plugins.intake.controllers.taught_points import program_bytes
from stitch.plugins.metrology.calibrate.arm_model import ArmModel
from stitch.session.reading.robot_description import robot_from_dh
from stitch.session.torques import torques_of
from tests.command_line import ended
from tests.plugins.intake.controllers.program_samples import ABB, FANUC, KUKA_DAT, KUKA_SRC, UR

ARM = ARMS["KUKA KR30-3"]
TABLE = robot_table(ARM)
ROBOT = robot_from_dh("KR30-3", "standard", TABLE["joints"], None, np.array(TABLE["gravity"]), "mm")
JOINTS = ARM.home + np.random.default_rng(5).uniform(-0.4, 0.4, (3, 6))


def pose(x, y, z, a, b, c):
    """A frame of KUKA's numbers, mm and degrees."""
    R = Rotation.from_euler("ZYX", [a, b, c], degrees=True)
    return frames.make(R.as_matrix(), np.array([x, y, z]))


TOOL, FRAME = pose(40, -25, 180, 30, -20, 10), pose(900, 200, 500, 35, 0, 0)
# Reach of the arm with its tool, mm; a joint rounded by so much turns the tool by less than reach times it.
REACH = 2500.0
ZERO = {"kuka": "0,0,0,0,0,0", "fanuc": "0,0,0,0,0,0", "abb": "0,0,0,1,0,0,0", "ur": "0,0,0,0,0,0"}
SAMPLES = [("a.ls", FANUC), ("a.dat", KUKA_DAT), ("a.mod", ABB), ("a.script", UR)]
ROWS = [[-1.25, -68.5, 111.0, 69.125, 67.0, 6.5], [10.0, -70.0, 100.0, -30.0, 55.5, 170.25]]
POSES = frames.exp(np.array([[0.3, -1.1, 0.4, 900.0, -120.5, 640.25], [0, 0, 1.0, 1.0, 2.0, 3.0]]))
ABOUT = "Drives to the view that decides between gear_eccentricity and gear_harmonic."


def at_zero(file):
    """--frame and --tool of a program whose poses are those of the flange in the base."""
    return [ZERO[{".ls": "fanuc", ".mod": "abb"}.get(file.suffix, "kuka")]] * 2


def arm_with(name, p):
    """The arm with nature's own parameters of one effect; the rest as a session of it would have them."""
    effect = EFFECTS[name]
    own = effect.parameters(6, torques_of(ROBOT, JOINTS).names, "mm")
    term = Term(effect, own).at(np.array([p.get(q.name, 0.0) for q in own]), np.full(len(own), np.nan))
    return ArmModel("cell", ROBOT, (term,), "mm", JOINTS)


def shown(T, controller):
    """A frame's numbers as --frame and --tool take them, by scipy."""
    R = Rotation.from_matrix(T[:3, :3])
    x, y, z, w = R.as_quat()
    turn = {
        "kuka": R.as_euler("ZYX", degrees=True),
        "fanuc": R.as_euler("xyz", degrees=True),
        "abb": [w, x, y, z],
        "ur": R.as_rotvec(),
    }[controller]
    return ",".join(f"{v:.12f}" for v in (*(T[:3, 3] / (1000 if controller == "ur" else 1)), *turn))


def reached(name, p, read):
    """Where the true arm takes the tool for the targets of a program: the controller's own kinematics are nominal."""
    commanded = [
        point.joints
        if point.joints is not None
        else kinematics.inverse(ARM, FRAME @ point.T_frame_tool @ np.linalg.inv(TOOL), JOINTS[k % 3])
        for k, point in enumerate(read.points)
    ]
    return true_flanges(name, p, ARM, np.array(commanded)) @ TOOL


# One that moves joints by torque, one by direction, one that changes the links; the others in `make check`.
LAWS = ["joint_compliance", "backlash", "link_geometry"]


LAWS += [
    pytest.param(name, marks=pytest.mark.slow)
    for name in ("joint_offset", "gear_eccentricity", "gear_harmonic", "settling")
]


@pytest.mark.parametrize("name", LAWS)
def test_the_true_arm_goes_where_the_program_meant(name, tmp_path):
    """Joint targets and poses of a tool in a frame; what remains is what the printed digits round away."""
    p = drawn(name, ARM, JOINTS, seed=3, amplitude=3.0)
    meant = np.vstack([kinematics.flange(ARM, JOINTS)] * 2) @ TOOL
    poses = [np.linalg.inv(FRAME) @ T for T in meant[3:]]
    (tmp_path / "w.src").write_bytes(program("kuka", JOINTS, poses).encode())
    read = read_program(tmp_path / "w.src", shown(FRAME, "kuka"), shown(TOOL, "kuka"))
    copy = compensated_program(read, arm_with(name, p))
    (tmp_path / "c.src").write_bytes(program_bytes(copy.texts[tmp_path / "w.src"]))
    after = read_program(tmp_path / "c.src", shown(FRAME, "kuka"), shown(TOOL, "kuka"))
    errors = [np.linalg.norm((reached(name, p, r) - meant)[:, :3, 3], axis=1) for r in (read, after)]
    moved = np.array([row["moved_mm"] for row in copy.rows()])
    assert errors[0].max() > 0.1
    # Five decimals of a degree in six joints, or four of a millimetre and five of a degree at the tool.
    assert errors[1].max() < 6 * np.radians(0.5e-5) * REACH
    # What the table says is what was wrong, up to the slope of the error itself.
    assert moved == pytest.approx(errors[0], rel=0.02, abs=2e-3)


@pytest.mark.parametrize("name", ARMS)
def test_arms_of_six_and_seven_joints_and_stretched_wrists(name):
    """Two turns of a wrist about one axis are no way to undo anything: what can be undone is."""
    own = ARMS[name]
    table = robot_table(own)
    robot = robot_from_dh(name, "standard", table["joints"], None, np.array(table["gravity"]), "mm")
    joints = own.home + np.random.default_rng(0).uniform(-0.3, 0.3, (4, own.joints))
    joints[0, 4] = 0.0
    p = drawn("gear_eccentricity", own, joints, seed=1, amplitude=3.0)
    parameters = EFFECTS["gear_eccentricity"].parameters(own.joints, (), "mm")
    term = Term(EFFECTS["gear_eccentricity"], parameters).at(np.array([p.get(q.name, 0.0) for q in parameters]))
    commanded, _, _, _ = compensate_targets(ArmModel("cell", robot, (term,), "mm", joints), joints, np.eye(4))
    meant = kinematics.flange(own, joints)
    before, after = (true_flanges("gear_eccentricity", p, own, q) - meant for q in (joints, commanded))
    assert np.abs(before[:, :3, 3]).max() > 0.05 and np.abs(after[:, :3, 3]).max() < 1e-6
    assert np.abs(commanded - joints).max() < 5e-3


@pytest.mark.parametrize("controller", SUFFIXES)
def test_every_controllers_targets_are_moved_alike(controller, tmp_path):
    """By its own digits: a listing of a FANUC has three decimals."""
    p = drawn("gear_eccentricity", ARM, JOINTS, seed=1, amplitude=4.0)
    meant = np.vstack([kinematics.flange(ARM, JOINTS)] * 2) @ TOOL
    file = tmp_path / f"w{SUFFIXES[controller]}"
    file.write_bytes(program(controller, JOINTS, [np.linalg.inv(FRAME) @ T for T in meant[3:]]).encode())
    frame, tool = shown(FRAME, controller), shown(TOOL, controller)
    copy = compensated_program(read_program(file, frame, tool), arm_with("gear_eccentricity", p))
    text = program_bytes(copy.texts[file])
    before, file_after = file.read_bytes(), tmp_path / f"c{SUFFIXES[controller]}"
    file_after.write_bytes(text)
    error = reached("gear_eccentricity", p, read_program(file_after, frame, tool)) - meant
    digit = 0.5e-3 if controller == "fanuc" else 0.5e-5
    # As printed, before and after: both programs are rounded.
    assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 2 * 6 * np.radians(digit) * REACH
    # Nothing but numbers has changed.
    number = re.compile(rb"-?\d*\.\d+")
    assert number.sub(b"#", text) == number.sub(b"#", before) and text != before


@pytest.mark.parametrize(("name", "text"), SAMPLES)
def test_without_an_error_of_the_arm_every_byte_stays(name, text, tmp_path):
    file = tmp_path / name
    file.write_bytes(text.replace("\n", "\r\n").encode() + "; Größe \n".encode("latin-1"))
    program = read_program(file, *at_zero(file))
    still = np.tile(np.eye(4), (len(program.points), 1, 1))
    texts = compensated_texts(program, still, np.zeros((len(program.points), 6)))
    assert program_bytes(texts[file]) == file.read_bytes()


@pytest.mark.parametrize(("name", "text"), SAMPLES)
def test_targets_moved_there_and_back_are_equal_to_the_last_printed_digit(name, text, tmp_path):
    """All numbers are written anew twice: the import of the copy is that of the original."""
    file = tmp_path / name
    file.write_text(text)
    first = import_file(file)
    move = frames.make(Rotation.from_rotvec([3e-3, -2e-3, 1e-3]).as_matrix(), np.array([0.4, -0.3, 0.2]))
    turn = np.full(6, 2e-3)
    for T, q in ((move, turn), (np.linalg.inv(move), -turn)):
        read = read_program(file, *at_zero(file))
        count = len(read.points)
        before = file.read_text()
        file.write_text(compensated_texts(read, np.tile(T, (count, 1, 1)), np.tile(q, (count, 1)))[file])
        assert file.read_text() != before
    cells = [re.split(r"[,\n]", table.text) for table in (first, import_file(file))]
    numbers = [[float(c) for c in own if re.fullmatch(r"-?[\d.e-]+", c)] for own in cells]
    # FANUC: two roundings of half a micrometre and of half a thousandth of a degree. The sample of an ABB has
    # quaternions of six digits, which are no unit to more.
    assert numbers[1] == pytest.approx(numbers[0], abs=1.001e-3 if name.endswith("ls") else 2e-5)


def test_a_motion_program_of_a_kuka_moves_the_points_of_its_data_list(tmp_path):
    (tmp_path / "a.src").write_text(KUKA_SRC)
    (tmp_path / "a.dat").write_text(KUKA_DAT)
    read = read_program(tmp_path / "a.src", ZERO["kuka"], ZERO["kuka"])
    assert [point.name for point in read.points] == ["XHOME", "XP1", "line6", "line7"]
    still = np.tile(np.eye(4), (4, 1, 1))
    texts = compensated_texts(read, still, np.full((4, 6), np.radians(0.25)))
    assert (
        "XHOME={A1 0.25000,A2 -89.75000" in texts[tmp_path / "a.dat"]
        and "X 1025.0,Y -12.5" in texts[tmp_path / "a.dat"]
    )
    assert "{A1 5.25000,A2 -79.75000" in texts[tmp_path / "a.src"]


@pytest.fixture(scope="module")
def stated(tmp_path_factory):
    """A run folder whose model says that joint 2 of the labelled arm is off by a milliradian."""
    folder = tmp_path_factory.mktemp("stated")
    session, *_ = labelled_cell(2, views=6)
    write_labelled(folder / "s", session)
    effects = {"joint_offset": {"d2": (1e-3, "rad")}}
    return bare_run(folder / "r", np.eye(4), np.eye(6), mount="eye_to_hand", effects=effects, session=folder / "s")


@pytest.mark.slow
def test_a_fitted_model_takes_the_error_down_to_its_own_uncertainty(tmp_path, stitch_command):
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = labelled_cell(2, views=30, offset=offset)
    write_labelled(tmp_path / "s", session)
    stitch_command("run", tmp_path / "s", "-o", tmp_path / "r", "--effects", "joint_offset", "--no-recording")
    joints = np.random.default_rng(8).uniform(-1, 1, (8, 6))
    (tmp_path / "w.script").write_text(program("ur", joints, []))
    out = stitch_command(
        "export", tmp_path / "r", "--program", tmp_path / "w.script", "-o", tmp_path / "c.script", "--json"
    )
    document = json.loads(out)
    commanded = [point.joints for point in read_program(tmp_path / "c.script").points]
    meant = [flange(q) for q in joints]
    before, after = (
        np.array([np.linalg.norm((flange(q, offset) - T)[:3, 3]) for q, T in zip(own, meant, strict=True)])
        for own in (joints, commanded)
    )
    U = np.array([row["U_mm"] for row in document["targets"]])
    # The arm itself scatters by 0.02 mm in each direction whenever it goes there: what thirty views leave is less.
    assert before.min() > 0.1 and (after < 0.02 * np.sqrt(3)).all() and (after < 2 * U).all()
    assert document["effects"] == ["joint_offset"] and not document["not_compensated"]


@pytest.mark.parametrize(
    ("name", "text", "options", "message"),
    [
        (
            "a.mod",
            ABB,
            {},
            r"a.mod: its poses are those of a tool in a frame that the file does not hold; to fix: state --frame and --tool",
        ),
        ("a.ls", FANUC, {"frame": ZERO["fanuc"]}, r"frame \(UF 1, UT 2\) .* state --tool as"),
        ("a.script", UR, {}, "state --tool as"),
        (
            "a.dat",
            KUKA_DAT.replace("E1 0.0,E2", "E1 250.0,E2", 1),
            {"frame": ZERO["kuka"], "tool": ZERO["kuka"]},
            "a.dat line 4: XP1 has E1 250; where an external axis",
        ),
        (
            "a.mod",
            ABB.replace("9E9,9E9,9E9,9E9,9E9,9E9]];\n  LOCAL", "120,9E9,9E9,9E9,9E9,9E9]];\n  LOCAL"),
            {"frame": ZERO["abb"], "tool": ZERO["abb"]},
            "a.mod line 3: p10 has eax_a 120",
        ),
        ("a.csv", "x,y,z\n1,2,3\n", {}, "unknown kind '.csv' of program"),
    ],
)
def test_programs_that_cannot_be_moved_are_refused(name, text, options, message, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_program(tmp_path / name, **options)


@pytest.mark.parametrize(
    ("name", "text", "other", "unread"),
    [
        ("a.src", KUKA_SRC.replace("LIN XP1", "CIRC XP1, XP1\nLIN XP1"), (), (5,)),
        ("a.dat", KUKA_DAT.replace("ENDDAT", "DECL FRAME TABLE={X 900,Y 0,Z 500,A 0,B 0,C 0}\nENDDAT"), ("TABLE",), ()),
        ("a.ls", FANUC.replace("/POS", "   2:L PR[4:home] 100mm/sec FINE    ;\n/POS"), (), (6,)),
        (
            "a.mod",
            ABB.replace(
                "  ENDPROC", "    MoveC p10, [[1,2,3],[1,0,0,0],[0,0,0,0],[9E9]], v100, fine, tool0;\n  ENDPROC"
            ),
            (),
            (12,),
        ),
        (
            "a.script",
            UR.replace(
                "end\n", "  tcp = p[0, 0, 0.2, 0, 0, 0]\n  set_tcp(tcp)\n  movec(p[1,0,0,0,0,0], p[0,1,0,0,0,0])\nend\n"
            ),
            ("tcp",),
            (12,),
        ),
    ],
)
def test_what_is_no_target_or_not_read_stays_and_is_named(name, text, other, unread, tmp_path):
    (tmp_path / "a.dat").write_text(KUKA_DAT)
    (tmp_path / name).write_text(text)
    read = read_program(tmp_path / name, *at_zero(tmp_path / name))
    assert read.other == other and read.unread == unread
    assert not {point.name for point in read.points} & set(other)


def test_what_is_too_large_or_out_of_reach_is_refused(tmp_path):
    p = {"d2": 4e-3}
    (tmp_path / "w.src").write_text(program("kuka", JOINTS, [FRAME]))
    read = read_program(tmp_path / "w.src", ZERO["kuka"], ZERO["kuka"])
    with pytest.raises(InputError, match=r"w.src line 3: line3 would move by .* mm and 4 mrad, more than the 5 mm"):
        compensated_program(read, arm_with("joint_offset", p))
    far = FRAME.copy()
    far[0, 3] = 9000
    (tmp_path / "far.src").write_text(program("kuka", [], [far]))
    with pytest.raises(InputError, match="far.src line 3: line3 is out of reach"):
        compensated_program(
            read_program(tmp_path / "far.src", *[ZERO["kuka"]] * 2), arm_with("joint_offset", {"d2": 1e-4})
        )
    with pytest.raises(NoResultError, match="no effect of the arm, so that a copy would be the same"):
        compensated_program(read, ArmModel("cell", ROBOT, (), "mm", JOINTS))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--program", "w.script"], "w.script: no output file; to fix"),
        (["--program", "w.script", "-o", "c.src"], "c.src: to fix: end the copy's name in .script"),
        (["--program", "w.script", "-o", "c.script", "--limit", "-1"], "--limit -1: to fix"),
        (["--program", "w.script", "-o", "c.script", "--limit", "0.01"], "more than the 0.01 mm"),
        (["--program", "w.script", "-o", "c.script", "--near", "1,2"], "--near 1,2: to fix: write 6 angles"),
        (["--program", "w.script", "--to", "ros"], "name one of --to FORMAT and --program FILE"),
        (
            ["--program", "w.ls", "-o", "c.ls", "--frame", ZERO["fanuc"], "--tool", ZERO["fanuc"]],
            "a FANUC's J3 turns with J2",
        ),
    ],
)
def test_refused_commands_write_nothing(stated, arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "w.script").write_text(program("ur", JOINTS, []))
    (tmp_path / "w.ls").write_text(program("fanuc", JOINTS, []))
    told = ended("export", stated, *arguments, code=2)
    assert message in told.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["w.ls", "w.script"]


def test_a_fanucs_third_joint_can_turn_with_its_second(stated, tmp_path, stitch_command):
    """The same arm and targets, once with J3 as the session has it and once from the horizontal."""
    joints = np.random.default_rng(8).uniform(-1, 1, (4, 6))
    shown = joints.copy()
    shown[:, 2] -= joints[:, 1]
    copies = []
    for name, own, j3 in (("own", joints, "own"), ("shown", shown, "j2+j3")):
        (tmp_path / f"{name}.ls").write_text(program("fanuc", own, []))
        stitch_command(
            "export", stated, "--program", tmp_path / f"{name}.ls", "-o", tmp_path / f"{name}-c.ls", "--j3", j3
        )
        copies.append(np.array([point.joints for point in read_program(tmp_path / f"{name}-c.ls").points]))
    copies[1][:, 2] += copies[1][:, 1]
    # Three decimals of a degree, rounded twice in each.
    assert copies[1] == pytest.approx(copies[0], abs=np.radians(2.1e-3))


SRC = """DEF place ()
LIN {X 2300.5, Y -120.0, Z 900.25, A 10.0, B -20.0, C 170.0} C_DIS ; in front
LIN {X 2310.0, Y -20.0, Z 900.0, A 12.0, B -21.0, C 171.0}
END
"""


MOD = "MODULE m\n  CONST robtarget p:=[[100,200,300],[0.5,0.5,0.5,0.5],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"


MOD += "  PROC main()\n    MoveL p,v100,fine,grip\\WObj:=rack;\n  ENDPROC\nENDMODULE\n"


NOMINAL, FOUND = pose(2300, 0, 500, 0, 0, 0), pose(2297, 4, 498, 0.3, -0.2, 0.1)


def fit_json(folder, **changed):
    found = {"length_unit": "mm", "T_base_part_nominal": NOMINAL.tolist(), "parts": [{"T_base_part": FOUND.tolist()}]}
    (folder / "fit.json").write_text(json.dumps(found | changed))
    return str(folder)


def numbers(text):
    return [[float(x) for x in re.findall(r"[XYZABC] (-?[\d.]+)", line)] for line in re.findall(r"\{(.*?)\}", text)]


@pytest.mark.parametrize("frame", ["0,0,0,0,0,0", "500,-40,30,90,5,-3"])
def test_targets_stand_to_the_found_part_as_to_the_nominal_one(tmp_path, frame):
    (tmp_path / "place.src").write_text(SRC)
    out = tmp_path / "out.src"
    ended("export", fit_json(tmp_path), "--program", tmp_path / "place.src", "-o", out, "--frame", frame)
    F = pose(*map(float, frame.split(",")))
    for before, after in zip(numbers(SRC), numbers(out.read_text()), strict=True):
        in_part = np.linalg.inv(NOMINAL) @ F @ pose(*before)
        assert np.abs(np.linalg.inv(FOUND) @ F @ pose(*after) - in_part).max() < 2e-4  # four decimals are written
    assert re.sub(r"-?\d+\.\d+", "", out.read_text()) == re.sub(r"-?\d+\.\d+", "", SRC)


def test_metres_and_a_quaternion(tmp_path):
    """A work object at zero; T_base_part in m, the program in mm."""
    metres = np.diag([1e-3, 1e-3, 1e-3, 1])
    found, nominal = (metres @ T @ np.linalg.inv(metres) for T in (FOUND, NOMINAL))
    folder = fit_json(
        tmp_path, length_unit="m", T_base_part_nominal=nominal.tolist(), parts=[{"T_base_part": found.tolist()}]
    )
    (tmp_path / "p.mod").write_text(MOD)
    ended("export", folder, "--program", tmp_path / "p.mod", "-o", tmp_path / "q.mod", "--frame", ZERO["abb"])
    place, q = re.search(r"\[\[(.*?)\],\[(.*?)\]", (tmp_path / "q.mod").read_text()).groups()
    w, *xyz = map(float, q.split(","))
    T = frames.make(Rotation.from_quat([*xyz, w]).as_matrix(), np.array([float(x) for x in place.split(",")]))
    meant = frames.make(Rotation.from_quat([0.5] * 4).as_matrix(), np.array([100, 200, 300]))
    assert np.abs(T - FOUND @ np.linalg.inv(NOMINAL) @ meant).max() < 2e-4


@pytest.mark.parametrize(
    ("changed", "program", "more", "message"),
    [
        ({"T_base_part_nominal": None}, SRC, (), "states no [nominal]"),
        ({"length_unit": None}, SRC, (), 'states no length_unit = "mm"'),
        ({"parts": None}, SRC, (), "is no fit.json of this version"),
        ({}, SRC, ("--part", "2"), "has 1 parts, no part 2"),
        ({}, "PTP {A1 0, A2 -90, A3 90, A4 0, A5 10, A6 0}\n", (), "line1 is taught by joint angles"),
    ],
)
def test_what_cannot_follow_is_refused(tmp_path, changed, program, more, message):
    (tmp_path / "place.src").write_text(program)
    told = fit_json(tmp_path, **changed), "--program", tmp_path / "place.src", "-o", tmp_path / "o.src"
    refused = ended("export", *told, "--frame", ZERO["kuka"], *more, code=2).err
    assert message in " ".join(refused.split()) and not (tmp_path / "o.src").exists()


@pytest.mark.parametrize("ending", [".src", ".mod", ".ls", ".script"])
def test_a_joint_program_is_read_back_with_the_angles_that_were_written(tmp_path, ending):
    file = tmp_path / f"next{ending}"
    file.write_bytes(next_program(file, ROWS, POSES, ABOUT, j3="own").encode())
    read = np.degrees([point.joints for point in read_program(file).points])
    np.testing.assert_allclose(read, ROWS, atol=6e-4)


def test_a_yaskawa_job_is_read_back_with_the_flange_in_the_base(tmp_path):
    file = tmp_path / "next.jbi"
    file.write_bytes(next_program(file, ROWS, POSES, ABOUT).encode())
    np.testing.assert_allclose([point.T_frame_tool for point in read_program(file).points], POSES, atol=6e-4)


@pytest.mark.parametrize("ending", [".src", ".mod", ".ls", ".script", ".jbi"])
def test_every_program_says_that_it_has_to_be_checked_and_stops_at_each_view(ending, tmp_path):
    text = next_program(tmp_path / f"next{ending}", ROWS, POSES, ABOUT, j3="own")
    told = " ".join(line.split("!")[-1].rstrip(" ;") for line in text.splitlines())
    assert "reduced speed" in told
    stops = {".src": "HALT", ".mod": "Stop;", ".ls": "PAUSE ;", ".script": "popup(", ".jbi": "PAUSE"}
    assert text.count(stops[ending]) == len(ROWS)


def test_the_joints_of_a_fanuc_count_from_the_horizontal(tmp_path):
    file = tmp_path / "next.ls"
    with pytest.raises(InputError, match=r"--j3 j2\+j3"):
        next_program(file, ROWS, POSES, ABOUT)
    file.write_text(next_program(file, ROWS, POSES, ABOUT, j3="j2+j3"))
    read = np.degrees([point.joints for point in read_program(file).points])
    np.testing.assert_allclose(read[:, 2], [q[2] - q[1] for q in ROWS], atol=6e-4)


def test_an_ending_that_no_controller_has_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"\.src, \.mod, \.ls, \.script, \.jbi"):
        next_program(tmp_path / "next.txt", ROWS, POSES, ABOUT)


def test_a_job_in_pulses_is_refused_with_its_line(tmp_path):
    file = tmp_path / "old.jbi"
    file.write_text("/JOB\n//NAME A\n//POS\n///POSTYPE PULSE\n///PULSE\nC00000=1,2,3,4,5,6\n//INST\n")
    with pytest.raises(InputError, match="line 6: C00000 is in pulses"):
        read_program(file)
