"""Every refusal of a folder carries what leads on as data: done to the letter, it ends in a session, never in a circle."""

import ast
import json
import shlex
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.raw_folders import Convention, raw_folder
from data_synth.write import write_session
from stitch.numerics import frames
from stitch.plugins.intake import refusals
from stitch.plugins.intake.make_session import make_session
from stitch.plugins.intake.refusals import Fix, Refusal, change, state
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.session_folder import load_session

INTAKE = Path(refusals.__file__).parent
STEPS = 3
STATED = {"rotation": "xyz-extrinsic", "angles": "rad", "unit": "mm", "cloud_unit": "mm", "mount": "eye_to_hand"}
STATED |= {"inverse": "no"}
TABLE = "RobotPoses.dat"


@cache
def small_cell():
    """A cell of which the scans overlap."""
    return measured_blade(3, 8, "eye_in_hand", (0.0, 0.0), pixels=50)


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


def scaled(factor, number=None):
    """All clouds, or one of them, so many times as large."""

    def spoil(folder):
        files = sorted(folder.glob("*.ply"))
        for file in files if number is None else [files[number]]:
            points = read_cloud(file).points
            file.unlink()
            np.save(file.with_suffix(".npy"), factor * points)
        for file in folder.glob("*.ply"):
            np.save(file.with_suffix(".npy"), read_cloud(file).points)
            file.unlink()

    return spoil


def poses_of(folder):
    """T_base_flange (V, 4, 4) as the table has them."""
    x = np.array([[float(cell) for cell in row.split(",") if cell] for row in (folder / TABLE).read_text().split()])
    return frames.make(Rotation.from_euler("xyz", x[:, :3]).as_matrix(), x[:, 3:])


def moved_scans(move):
    """Scans whose points (N, 3), of the view i at the pose T (4, 4), are others."""

    def spoil(folder):
        for i, (file, T) in enumerate(zip(sorted(folder.glob("*.ply")), poses_of(folder), strict=True)):
            points = move(i, T @ small_cell().T_mount, read_cloud(file).points)
            file.unlink()
            np.save(file.with_suffix(".npy"), points)

    return spoil


def of_another_part(i, T, points):
    """The part sheared, from the fifth view on."""
    part = frames.transform(T, points)
    middle = np.array(MIDDLE)
    part = part if i < 4 else (part - middle) @ SHEAR.T + middle
    return frames.transform(np.linalg.inv(T), part)


def before_a_wall(i, T, points):
    """Behind the part a wall that stands still before the scanner, of as many points."""
    random = np.random.default_rng(i)
    wall = random.uniform((-60, -60, 520), (60, 60, 520), (len(points), 3))
    return np.vstack([points, wall + 0.02 * random.standard_normal(wall.shape)])


def later_rows(shift):
    """The base changed at the fifth view."""

    def edit(rows):
        x = [[float(cell) for cell in row.split(",") if cell] for row in rows]
        return [
            ",".join(map(str, [*row[:3], *(np.array(row[3:]) + (i >= 4) * np.array(shift))])) for i, row in enumerate(x)
        ]

    return lines(edit)


def workbook(*sheets):
    """A workbook in place of the table."""

    def spoil(folder):
        openpyxl, rows = pytest.importorskip("openpyxl"), (folder / TABLE).read_text().split()
        pytest.importorskip("python_calamine")
        (folder / TABLE).unlink()
        book = openpyxl.Workbook()
        book.remove(book.active)
        for sheet in sheets:
            page = book.create_sheet(sheet)
            for row in rows if "pose" in sheet else ["nothing,here"]:
                page.append([float(cell) if "pose" in sheet else cell for cell in row.split(",") if cell])
        book.save(folder / "poses.xlsx")

    return spoil


SHEAR = np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.2], [0.1, 0.0, 1.0]])
# Of the part in the base, mm.
MIDDLE = (0.0, 0.0, 0.0)
NOTHING_STATED = dict.fromkeys(STATED)
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
    "no such folder": (shutil.rmtree, {}, "no such folder", {}),
    "one cloud in another unit": (scaled(1000.0, 1), {}, "in another unit", {}),
    "a point among decimal commas": (
        lines(
            lambda rows: [";".join(r.strip(",").split(",")).replace(".", "," if i else ".") for i, r in enumerate(rows)]
        ),
        {},
        "has a point, other numbers",
        {},
    ),
    "no sheet with numbers": (workbook("notes"), {"poses": "poses.xlsx"}, "no sheet holds rows", {}),
    "several sheets": (workbook("poses of today", "poses"), {"poses": "poses.xlsx"}, "2 sheets hold rows", {}),
    "an arm that never stops": (
        lines(lambda rows: [f"{0.05 * i},0.2,0.3,{400 + 9 * i},100,500" for i in range(30)]),
        {},
        "the arm stops 0 times",
        {"rows": "3,4,5"},
    ),
    "nothing that tells": (
        nothing,
        {"guess": None, "mount": None, "cloud_unit": None},
        "cannot be told from these",
        {},
    ),
}
# Of scans that overlap, with nothing stated: the scans themselves tell what is wrong.
OF_SCANS = {
    "a base that changed": (later_rows([30.0, 0.0, 150.0]), NOTHING_STATED, "changed at", {}),
    "two parts": (moved_scans(of_another_part), NOTHING_STATED, "two parts, or one that changed", {}),
    "a wall behind": (moved_scans(before_a_wall), NOTHING_STATED, "stands still before the scanner", {}),
    "in one frame": (
        moved_scans(lambda i, T, points: frames.transform(T, points)), NOTHING_STATED, "lie in one frame already", {},
    ),
    "a scale of their own": (scaled(1.7), NOTHING_STATED, "times as large as the robot's motions", {}),
    "rows in any order": (
        lines(lambda rows: [rows[i] for i in (3, 6, 1, 7, 0, 2, 5, 4)]), NOTHING_STATED, "no session was written", {},
    ),
}  # fmt: skip
QUICK = tuple(INPUTS)
INPUTS |= OF_SCANS


# Functions that make a refusal which others raise, all of them provoked here; the last, of arrays that a program
# passes, has no folder.
MAKERS = {"_no_clouds", "_no_rows", "_has_marks", "several_lists", "_in_another_unit", "named", "_told_by_scans"}
# Functions that refuse what OF_SCANS provokes.
ASKING_THE_SCANS = {
    "require_no_background",
    "require_own_frames",
    "require_scale",
    "require_no_change",
    "require_one_part",
}
ASKING_THE_SCANS |= {"_require_fit"}
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


@pytest.fixture(scope="module")
def overlapping(tmp_path_factory):
    """A folder that is right, of scans that overlap."""
    folder = tmp_path_factory.mktemp("overlapping")
    write_session(folder / "cell", small_cell(), "cell")
    return raw_folder(folder / "cell", folder / "raw", Convention())


def provoked(folder, options, force):
    """The refusal of a folder; None where a session was written, which can be read."""
    beside = options.pop("beside", None)
    out = folder if beside else folder.with_name("made")
    try:
        make_session(folder, out, {n: v for n, v in options.items() if v}, guess="guess" not in options, force=force)
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
    options.pop("output", None)
    for name, value in fix.options.items():
        told = answers.get(name) if value.isupper() else value
        options.pop(name, None) if not told else options.update({name: told})
    options.pop("output", None)
    if fix.file is not None:
        # The files as they should be.
        folder.mkdir(exist_ok=True)
        for file in folder.iterdir():
            file.rmdir() if file.is_dir() else file.unlink()
        shutil.copytree(pristine, folder, dirs_exist_ok=True)
        options.pop("poses", None)
    return bool(options.pop("force", None))


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in OF_SCANS)])
def test_what_a_refusal_says_done_to_the_letter_makes_a_session(session, overlapping, tmp_path, name):
    spoil, given, says, other = INPUTS[name]
    pristine = overlapping if name in OF_SCANS else raw_folder(session, tmp_path / "pristine" / "raw", Convention())
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


def test_every_function_that_refuses_is_in_the_table_or_makes_one_for_others():
    if not {*QUICK} <= RUN:
        pytest.skip("the table has not run whole")
    slow = set() if {*INPUTS} == RUN else ASKING_THE_SCANS
    assert refusing_functions() - REFUSING - MAKERS - slow == set()


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
