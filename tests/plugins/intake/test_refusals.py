"""Every refusal of a folder carries what leads on as data: done to the letter, it ends in a session, never in a circle."""

import ast
import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from data_synth.fixtures.raw_folders import Convention, raw_folder
from stitch.plugins.intake import refusals
from stitch.plugins.intake.make_session import make_session
from stitch.plugins.intake.refusals import Fix, Refusal, change, state
from stitch.session.reading.session_folder import load_session

INTAKE = Path(refusals.__file__).parent
STEPS = 3
STATED = {"rotation": "xyz-extrinsic", "angles": "rad", "unit": "mm", "cloud_unit": "mm", "mount": "eye_to_hand"}
STATED |= {"inverse": "no"}
TABLE = "RobotPoses.dat"


def lines(change_lines):
    """Change the lines of the table."""

    def spoil(folder):
        table = folder / TABLE
        table.write_text("\n".join(change_lines(table.read_text().splitlines())) + "\n")

    return spoil


def written(name, text):
    """Another table in the place of the poses."""

    def spoil(folder):
        (folder / TABLE).unlink()
        (folder / name).write_text(text)

    return spoil


def cells(number, position, text):
    """One cell of one line in other words."""

    def edit(rows):
        row = rows[number].split(",")
        row[position] = text
        return [*rows[:number], ",".join(row), *rows[number + 1 :]]

    return lines(edit)


def each(make):
    """A file a view in place of the table."""

    def spoil(folder):
        rows = (folder / TABLE).read_text().splitlines()
        (folder / TABLE).unlink()
        for i, row in enumerate(rows):
            (folder / f"pose_{i}.txt").write_text(make(i, row) + "\n")

    return spoil


def clouds(edit):
    """All clouds in another way."""
    return lambda folder: [edit(file) for file in sorted(folder.glob("*.ply"))]


def as_xyz(points):
    """The clouds as text of so few or such points."""

    def edit(file):
        file.unlink()
        np.savetxt(file.with_suffix(".xyz"), points)

    return clouds(edit)


def nothing(folder):
    """The folder is right; what is stated is not."""


LINE = np.column_stack([np.linspace(-20, 20, 500), np.zeros(500), 300 + np.sin(np.linspace(0, 3, 500))])
JOINTS = "shoulder_pan_joint,shoulder_lift_joint,elbow_joint,wrist_1_joint,wrist_2_joint,wrist_3_joint"
SIX = "0.1,0.2,0.3,0.4,0.5,0.6"
# What is spoiled, what is stated besides, what the refusal says, and what the person answers in place of the usual.
INPUTS = {
    "no such file": (nothing, {"poses": "nowhere.csv"}, "no such file", {}),
    "no such list": (nothing, {"poses": f"{TABLE}#other"}, "has no list other", {}),
    "empty folder of poses": (lambda f: (f / "none").mkdir(), {"poses": "none"}, "no files of poses", {}),
    "no clouds": (clouds(lambda file: file.unlink()), {}, "no clouds there", {}),
    "packed clouds": (clouds(lambda file: file.rename(file.with_suffix(".zip"))), {}, "only packed", {}),
    "no poses": (written("notes.txt", "nothing to see\n"), {}, "no rows of numbers", {}),
    "no poses among several": (
        lambda f: [
            written("a.txt", "1 2 3 4 5\n4 5 7 8 9\n5 5 6 6 9\n")(f),
            (f / "b.csv").write_text("7,8,1,1\n8,8,9,3\n1,1,2,0\n"),
        ],
        {},
        "no list of poses there",
        {},
    ),
    "two tables": (
        lambda f: (f / "robot.txt").write_text((f / TABLE).read_text().replace("0.", "0.1")),
        {},
        "several lists",
        {},
    ),
    "few names": (nothing, {"columns": "x,y,z"}, "3 names", {}),
    "a name twice": (nothing, {"columns": "x,x,z,rx,ry,rz"}, "x stands twice", {}),
    "unknown order": (nothing, {"rotation": "zyx"}, "--rotation zyx", {}),
    "order of another kind": (nothing, {"rotation": "quaternion-xyzw"}, "the rotation has 3 numbers", {}),
    "orientation beside one": (nothing, {"orientation": "1,2"}, "--orientation: 2 numbers", {"orientation": None}),
    "box upside down": (nothing, {"within": "1,1,1,0,0,0"}, "the lowest and the highest", {}),
    "box of words": (nothing, {"within": "a,b"}, "is no list of numbers", {}),
    "rows of words": (nothing, {"rows": "first"}, "first is no row", {}),
    "rows of others": (nothing, {"rows": "1-2"}, "2 for 3 clouds", {}),
    "too many poses": (lines(lambda rows: rows * 3), {}, "3 clouds and 9 poses", {}),
    "no rotation": (
        lines(lambda rows: ["x,y,z", *(",".join(row.split(",")[3:6]) for row in rows)]),
        {},
        "without a rotation",
        {},
    ),
    "joints by name": (lines(lambda rows: [JOINTS, *[SIX] * 3]), {}, "of which the robot's URDF", {}),
    "joints": (lines(lambda rows: ["j1,j2,j3,j4,j5,j6", *[SIX] * 3]), {}, "joint angles need the robot", {}),
    "columns of nothing": (
        lines(lambda rows: [f"{i}.5,7.25,{row.rstrip(',')}" for i, row in enumerate(rows)]),
        {},
        "hold no pose that is known",
        {"columns": "-,-,rx,ry,rz,x,y,z"},
    ),
    "a word": (cells(1, 2, "abc"), {}, "is no number", {}),
    "marks for thousands": (cells(1, 4, "1'203.441"), {}, "marks for thousands", {}),
    "digits that are no numbers": (
        lines(lambda rows: ["rx,ry,rz,x,y,z", *(f"{row.strip(',')}/1" for row in rows)]),
        {},
        "in column z is no number",
        {},
    ),
    "a row too short": (lines(lambda rows: [rows[0], rows[1][:20], rows[2]]), {}, "other rows have", {}),
    "a session there": (lambda f: (f / "session.toml").write_text(""), {"beside": "yes"}, "exists already", {}),
    "broken JSON": (written("poses.json", "{"), {"poses": "poses.json"}, "not valid JSON", {}),
    "unlike JSON": (
        written(
            "poses.json",
            json.dumps([dict(zip("xyzabc", range(6), strict=True)), {"x": 1, "y": 2, "z": 3, "q": 1, "r": 2}]),
        ),
        {"poses": "poses.json"},
        "is written otherwise",
        {},
    ),
    "broken array": (written("poses.npy", "none"), {"poses": "poses.npy"}, "cannot be read", {}),
    "array of words": (
        lambda f: [(f / TABLE).unlink(), np.save(f / "poses.npy", np.array(["a"]))],
        {"poses": "poses.npy"},
        "holds no array",
        {},
    ),
    "not finite": (lines(lambda rows: [rows[0], *["nan,nan,nan,nan,nan,nan"] * 2]), {}, "not finite", {}),
    "files unlike": (each(lambda i, row: row if i else f"{row}7,8"), {}, "is written otherwise", {}),
    "several in a file": (each(lambda i, row: row if i else f"{row}\n{row}"), {}, "one a file is expected", {}),
    "no surface": (as_xyz(np.ones((2, 3))), {}, "points show no surface", {}),
    "lines of a laser": (as_xyz(LINE), {}, "one profile of a laser line", {"ball": "30"}),
}


# Functions that refuse and are not in the table: what needs scans that overlap, arms or files of size is provoked in
# tests of its own and in the tables field-cases, drawn-folders and field-kinds.
ELSEWHERE = {
    "require_no_background", "require_own_frames", "require_scale", "require_no_change", "require_one_part", "_require_fit",
    "_require_determined", "rows_with_scans", "_without_folder", "_from_workbook", "header_poses", "_no_rows",
    "_require_one_decimal_mark", "_split_header", "_read_file", "_in_another_unit", "_read_clouds", "_require_folder",
    "_told_by_scans", "several_lists",
    "_no_clouds", "_has_marks", "named",  # these make one for others
}  # fmt: skip
REFUSING: set[str] = set()
RUN: set[str] = set()


def refusing_functions():
    """Names of the functions of the intake that make a refusal."""
    found = set()
    for file in INTAKE.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                calls = [c.func for c in ast.walk(node) if isinstance(c, ast.Call)]
                found |= {node.name} if any(getattr(c, "id", "") == "Refusal" for c in calls) else set()
    return found


@pytest.fixture
def pristine(session, tmp_path):
    """A folder that is right."""
    return raw_folder(session, tmp_path / "pristine" / "raw", Convention())


def provoked(folder, options, force):
    """The refusal of a folder; None where a session was written, which can be read."""
    beside = options.pop("beside", None)
    out = folder if beside else folder.with_name("made")
    try:
        make_session(folder, out, options, guess=True, force=force)
    except Refusal as refused:
        trace = refused.__traceback__
        while trace is not None:
            REFUSING.add(trace.tb_frame.f_code.co_name)
            trace = trace.tb_next
        return refused
    assert load_session(out).views
    return None


def obey(fix, folder, pristine, options, answers):
    """Do what a fix says; return whether a session may be replaced."""
    for name, value in fix.options.items():
        told = answers.get(name) if value.isupper() else value
        options.pop(name, None) if not told else options.update({name: told})
    if fix.file is not None:
        # The files as they should be.
        for file in folder.iterdir() if folder.is_dir() else ():
            file.rmdir() if file.is_dir() else file.unlink()
        shutil.copytree(pristine, folder, dirs_exist_ok=True)
        options.pop("poses", None)
    return bool(options.pop("force", None))


@pytest.mark.parametrize("name", INPUTS)
def test_what_a_refusal_says_done_to_the_letter_makes_a_session(pristine, tmp_path, monkeypatch, name):
    spoil, given, says, other = INPUTS[name]
    RUN.add(name)
    folder = tmp_path / "raw"
    shutil.copytree(pristine, folder)
    spoil(folder)
    answers = STATED | {"poses": str(pristine / TABLE), "columns": "rx,ry,rz,x,y,z", "rows": "1-3"}
    answers |= {"orientation": "0.1,0.2,0.3", "within": "-999,-999,-999,999,999,999"} | other
    options, force, said = STATED | given, False, list[str]()
    for _ in range(STEPS + 1):
        refused = provoked(folder, options, force)
        if refused is None:
            break
        assert refused.fixes and refused.what not in said, refused.command_line
        said.append(refused.what)
        force = obey(refused.fixes[0], folder, pristine, options, answers)
    else:
        pytest.fail(" | ".join(said))
    assert said and says in said[0]


def test_every_function_that_refuses_is_in_the_table_or_named_as_provoked_elsewhere():
    if {*INPUTS} != RUN:
        pytest.skip("the table has not run whole")
    assert refusing_functions() - REFUSING - ELSEWHERE == set()


def test_a_fix_is_the_same_on_the_command_line_and_in_python(tmp_path):
    fix = state(cloud_unit="m", rows="1-3,-")
    typed = shlex.split(fix.command(tmp_path))
    call = ast.parse(fix.python(tmp_path), mode="eval").body
    passed = {word.arg: ast.literal_eval(word.value) for word in call.keywords}
    assert typed[:3] == ["stitch", "init", str(tmp_path)] and ast.literal_eval(call.args[0]) == str(tmp_path)
    assert dict(zip(typed[3::2], typed[4::2], strict=True)) == {"--cloud-unit": "m", "--rows": "1-3,-"}
    assert passed == {"cloud_unit": "m", "rows": "1-3,-"}


def test_each_caller_reads_the_fix_in_its_own_words():
    refused = Refusal("scans: ten times as large", state(cloud_unit="cm"), change("a.ply", "export it again"))
    assert refused.command_line.endswith("to fix: state --cloud-unit cm, or export it again")
    assert str(refused).endswith("to fix: pass cloud_unit='cm', or export it again")
    assert Refusal("--rotation zyx:", Fix("use xyz")).command_line == "--rotation zyx: to fix: use xyz"
