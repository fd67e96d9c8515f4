"""Sessions: what is read, and the one line that every bad input gets."""

import csv
import io
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from conftest import measured_blade
from pyarrow.parquet import read_table

from data_synth.write import write_session
from stitch import frames
from stitch.cli.main import main
from stitch.effects import EFFECTS
from stitch.errors import InputError
from stitch.measurement.robot import forward
from stitch.model.model_toml import Model, read_model, write_model
from stitch.pipeline import run
from stitch.reading.dh_rows import robot_from_dh
from stitch.reading.session_folder import load_session


@pytest.fixture
def session(tmp_path):
    """A small blade session on disk."""
    measured = measured_blade(0, views=3, pixels=50)
    # A rail leaves joints and robot out: each test adds what it is about.
    write_session(tmp_path / "s", replace(measured, scene=replace(measured.scene, rail=1.0), covariates={}), "s")
    file = tmp_path / "s" / "views.csv"
    rows = [line.split(",") for line in file.read_text().splitlines()]
    file.write_text("\n".join(",".join(row[:2] + row[3:-1]) for row in rows) + "\n")
    return tmp_path / "s"


def edit(path, old, new, count=1):
    text = path.read_text()
    assert re.search(old, text), (old, text)
    path.write_text(re.sub(old, new, text, count=count))


def test_good_session(session):
    loaded = load_session(session)
    assert [view.name for view in loaded.views] == ["v000", "v001", "v002"]
    assert loaded.mount == "eye_to_hand"
    assert loaded.scanner.noise == 0.02
    assert np.allclose(loaded.scanner.optical_axis, [0, 0, 1])


def spoil_cell(row, column, value):
    """An edit of one cell of views.csv."""

    def edit_csv(folder):
        rows = list(csv.reader(io.StringIO((folder / "views.csv").read_text())))
        rows[row][rows[0].index(column)] = value
        (folder / "views.csv").write_text("\n".join(",".join(r) for r in rows) + "\n")

    return edit_csv


def remove(name):
    return lambda folder: (folder / name).unlink()


def write_cloud(text):
    def spoil(folder):
        (folder / "clouds/v001.xyz").write_text(text)
        spoil_cell(2, "cloud", "clouds/v001.xyz")(folder)

    return spoil


def toml(old, new):
    return lambda folder: edit(folder / "session.toml", old, new)


def table(text):
    """A table more in session.toml."""
    return toml(r"\[scanner\]", f"{text}\n[scanner]")


def open_quote(folder):
    """A quote on line 3 that nobody closes, in a file larger than what csv takes for one cell."""
    rows = (folder / "views.csv").read_text().splitlines()
    (folder / "views.csv").write_text("\n".join([*rows[:2], '"' + rows[2], *rows[3:] * 2000]) + "\n")


BAD = {
    "no session.toml": (remove("session.toml"), ["session.toml", "not found"]),
    "no views.csv": (remove("views.csv"), ["views.csv", "not found"]),
    "missing cloud": (remove("clouds/v001.ply"), ["v001", "line 3", "no such cloud"]),
    "view without pose": (
        lambda f: [spoil_cell(2, c, "")(f) for c in ("x", "y", "z", "qx", "qy", "qz", "qw")], ["line 3", "v001", "no pose"]),
    "pose half given": (spoil_cell(2, "qz", ""), ["line 3", "qz"]),
    "not a number": (spoil_cell(3, "x", "12,5".replace(",", ";")), ["line 4", "x is '12;5'"]),
    "quaternion": (spoil_cell(1, "qw", "3.0"), ["line 2", "v000", "unit quaternion"]),
    "twice the same view": (spoil_cell(2, "view", "v000"), ["line 3", "line 2"]),
    "NaN in a cloud": (write_cloud("1 2 400\nnan 2 400\n"), ["v001", "1 of 2 points"]),
    "no points": (write_cloud("# x y z\n"), ["v001", "no points"]),
    "words in a cloud": (write_cloud("1 2 400\n1 two 400\n"), ["v001", "cannot be read"]),
    "not a rotation": (toml(r"pose = \[\s*\[[^,]*,", "pose = [[2.0,"), ["scanner.pose", "not a rigid motion"]),
    "metres read as millimetres": (toml('length_unit = "mm"', 'length_unit = "mm"\ncloud_unit = "m"'), ["cloud_unit", "1000", "v000"]),
    "poses in metres": (toml('length_unit = "mm"', 'length_unit = "m"\ncloud_unit = "mm"'), ["length_unit", "1000"]),
    "unknown key": (toml("standoff", "standof"), ["scanner.standof", "standoff"]),
    "wrong mount": (toml("eye_to_hand", "eye_on_hand"), ["mount", "eye_in_hand"]),
    "wrong unit": (toml('"mm"', '"cm"'), ["length_unit", "'cm'"]),
    "format": (toml("stitch-session/1", "stitch-session/9"), ["format", "stitch-session/1"]),
    "broken TOML": (toml("mount = ", "mount "), ["not valid TOML"]),
    "axis": (toml(r"\+z", "up"), ["optical_axis"]),
    "axis as a vector": (toml(r'"\+z"', "[0, 0, 1]"), ["scanner.optical_axis is [0, 0, 1]", '"+z"']),
    "axis that no effect knows": (toml(r"\+z", "-x"), ["scanner.optical_axis is '-x'", "turn the clouds"]),
    "gravity in words": (table('[robot]\njoints = [{ a = 1 }]\ngravity = "down"'), ["session.toml", "gravity is 'down'"]),
    "URDF that is no name": (table("[robot]\nurdf = 5"), ["session.toml", "robot.urdf is 5"]),
    "link that is no name": (table('[robot]\nurdf = "r.urdf"\nflange_link = ["a"]'), ["robot.flange_link is ['a']"]),
    "CAD that is no name": (table("[part]\ncad = 5"), ["part.cad is 5"]),
    "unit of the CAD": (table('[part]\ncad_unit = "inch"'), ["cad_unit is 'inch'", "'mm' or 'm'"]),
    "open quote": (open_quote, ["views.csv line 3", "quote"]),
    "one point": (write_cloud("1 2 400\n"), ["v001", "line 3", "1 of at least 3 points"]),
    "nothing but invalid points": (write_cloud("0 0 0\n0 0 0\n"), ["v001", "line 3", "all 2 points are 0 0 0"]),
    "noise": (toml("noise = 0.02", "noise = -1"), ["scanner.noise"]),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line_exit_2_and_leaves_nothing(session, tmp_path, capsys, name):
    spoil, expected = BAD[name]
    spoil(session)
    with pytest.raises(InputError) as error:
        load_session(session)
    assert "\n" not in str(error.value)
    for piece in expected:
        assert piece in str(error.value), str(error.value)
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "-o", str(tmp_path / "out" / "run")])
    assert ended.value.code == 2
    assert not (tmp_path / "out").exists()
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.strip() == f"stitch: {error.value}"


def test_check_reads_all_and_reports_each(session, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["check", str(session), str(session / "nowhere"), "--json"])
    assert ended.value.code == 2
    document = json.loads(capsys.readouterr().out)
    assert document["sessions"][0]["views"] == 3
    assert "nowhere" in document["errors"][0]


def test_usage_is_exit_2():
    for arguments in (["run"], ["run", "x", "--no-such-option"], ["fly"]):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 2


def test_an_existing_folder_that_is_no_run_is_not_touched(session, tmp_path):
    keep = tmp_path / "mine"
    keep.mkdir()
    (keep / "thesis.txt").write_text("all of it")
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "-o", str(keep)])
    assert ended.value.code == 2
    assert [path.name for path in keep.iterdir()] == ["thesis.txt"]


def test_a_run_cannot_take_the_place_of_the_folder_one_stands_in(session, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("stitch.cli.run.run_rig", lambda *_: pytest.fail("computed first"))
    (tmp_path / "here" / "inner").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "inner")
    for target in (".", "..", tmp_path / "here" / "inner"):
        with pytest.raises(SystemExit) as ended:
            main(["run", str(session), "-o", str(target)])
        assert ended.value.code == 2
        assert f"stitch: {target}: " in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.rglob("here/**/*")) == ["inner"]


def test_a_batch_goes_on_after_whatever_befalls_one_session(session, tmp_path, monkeypatch, capsys):
    """Also after an error that nobody foresaw."""
    shutil.copytree(session, tmp_path / "t")

    edit(tmp_path / "t" / "session.toml", "(?m)^name = .*$", 'name = "second"')

    def fails_once(loaded, recorder):
        if loaded.path.name == "s":
            raise ZeroDivisionError("by\nzero")
        return run(loaded, recorder=recorder)

    monkeypatch.setattr("stitch.cli.batch.run", fails_once)
    with pytest.raises(SystemExit) as ended:
        main(["batch", str(session), str(tmp_path / "t"), "-o", str(tmp_path / "runs"), "--json"])
    assert ended.value.code == 1
    bad, good = json.loads(capsys.readouterr().out)
    assert bad["error"] == "ZeroDivisionError: by zero" and good["error"] is None
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["second"]
    assert {"result.json", "recording.rrd"} <= {path.name for path in (tmp_path / "runs" / "second").iterdir()}


def test_a_batch_of_sessions_that_cannot_be_read_is_bad_input(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["batch", str(tmp_path / "nowhere"), "-o", str(tmp_path / "runs")])
    assert ended.value.code == 2
    assert "nowhere" in capsys.readouterr().err


def sees_points(folder):
    """Six labelled points on the flange, seen with 20 µm of noise."""
    loaded, rng = load_session(folder), np.random.default_rng(0)
    balls, rows = rng.normal(size=(6, 3)) * 50, ["view,target,x,y,z"]
    for view in loaded.views:
        T_scanner_flange = frames.inverse(loaded.scanner.T_mount) @ view.T_base_flange
        seen = frames.transform(T_scanner_flange, balls) + rng.normal(size=(6, 3)) * 0.02
        rows += [f"{view.name},ball{i},{x},{y},{z}" for i, (x, y, z) in enumerate(seen)]
    (folder / "points.csv").write_text("\n".join(rows) + "\n")


@pytest.mark.parametrize("kind", ["clouds", "points", "both"])
def test_residuals_with_gaps_in_the_times_and_covariates_named_like_columns(session, tmp_path, kind):
    if kind != "clouds":
        sees_points(session)
    if kind == "points":
        for row in (1, 2, 3):
            spoil_cell(row, "cloud", "")(session)
    rows = (session / "views.csv").read_text().splitlines()
    more = ("time_s,residual,nx", "0,5,7", ",6,", "9,5,8")
    (session / "views.csv").write_text("\n".join(f"{a},{b}" for a, b in zip(rows, more, strict=True)) + "\n")
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "-o", str(tmp_path / "run"), "--no-recording"])
    assert not ended.value.code
    table = read_table(tmp_path / "run" / "residuals.parquet")
    assert sorted(set(table.column_names)) == sorted(table.column_names)
    columns = {name: np.array(values) for name, values in table.to_pydict().items()}
    assert np.abs(columns["residual"]).max() < 4 and np.abs(columns["nx"]).max() <= 1
    assert ("ball0" in columns["partner"], "v001" in columns["partner"]) == (kind != "clouds", kind != "points")
    for view, *known in (("v000", 0, 5, 7), ("v001", np.nan, 6, np.nan)):
        own = columns["view"] == view
        for name, value in zip(("time_s", "covariate_residual", "covariate_nx"), known, strict=True):
            assert np.array_equal(np.unique(columns[name][own]), [value], equal_nan=True)


USER = """
from stitch.effects import effect, number

@effect("sensor", k=number("mm", typical=0.02, limit=1.0))
def of_my_own(points, view, k):
    return points
"""


@pytest.mark.parametrize(("name", "expected"), [("mine.txt", "mine.py"), ("mine.py", "'of_my_own' has no docstring")])
def test_effects_that_cannot_be_loaded_are_refused(tmp_path, capsys, name, expected):
    (tmp_path / name).write_text(USER)
    with pytest.raises(SystemExit) as ended:
        main(["effects", "--effects-file", str(tmp_path / name)])
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"stitch: {tmp_path / name}: ") and expected in printed and printed.count("\n") == 1
    assert "of_my_own" not in EFFECTS


@pytest.mark.parametrize(("old", "new", "expected"), [
    ('length_unit = "mm"', 'length_unit = "cm"', "length_unit is 'cm'"), ('length_unit = "mm"\n', "", "length_unit is None"),
    ("^", "effects_file = 5\n", "effects_file is 5"),
])  # fmt: skip
def test_a_model_that_was_edited_wrongly_is_refused(tmp_path, old, new, expected):
    file = tmp_path / "model.toml"
    write_model(Model("mm", "eye_to_hand", np.eye(4), np.eye(4), np.eye(6)), file)
    edit(file, old, new)
    with pytest.raises(InputError, match=f"model.toml: {expected}; "):
        read_model(file)


JOINTS = [
    {"a": 100, "alpha_deg": 90, "d": 400},
    {"a": 500, "d": 0, "alpha_deg": 0},
    {"a": 300, "d": 50, "alpha_deg": 20},
]


def joints_session(folder, rows, header="view,cloud,j1_deg,j2_deg,j3_deg,humidity,note"):
    rows_text = ", ".join(f"{{ a = {j['a']}, alpha_deg = {j['alpha_deg']}, d = {j['d']} }}" for j in JOINTS)
    edit(folder / "session.toml", r"\[scanner\]", f'[robot]\ndh = "standard"\njoints = [{rows_text}]\n[scanner]')
    (folder / "views.csv").write_text("\n".join([header, *rows]) + "\n")


def test_joints_give_the_pose_the_approach_and_covariates(session):
    joints_session(
        session,
        ["a,clouds/v000.ply,10,20,30,41,first", "b,clouds/v001.ply,5,20,40,42,", "c,clouds/v002.ply,5,30,20,,x"],
    )
    views = load_session(session).views
    robot = robot_from_dh("r", "standard", JOINTS, None, np.zeros(3), "mm")
    assert np.allclose(views[1].T_base_flange, forward(robot, np.radians([5, 20, 40])))
    assert views[0].approach.tolist() == [0, 0, 0]
    assert views[1].approach.tolist() == [-1, 0, 1]
    assert [view.covariates for view in views] == [{"humidity": 41.0}, {"humidity": 42.0}, {}]


def test_joints_and_pose_that_contradict_are_refused(session):
    rows = (session / "views.csv").read_text().splitlines()
    header = rows[0] + ",j1_deg,j2_deg,j3_deg"
    joints_session(session, [row + ",10,20,30" for row in rows[1:]], header)
    with pytest.raises(InputError, match="line 2.* mm and .*check robot.dh"):
        load_session(session)


def test_rows_out_of_the_order_of_time_are_refused(session):
    rows = (session / "views.csv").read_text().splitlines()
    more = ("time_s", "100", "", "50")
    (session / "views.csv").write_text("\n".join(f"{a},{b}" for a, b in zip(rows, more, strict=True)) + "\n")
    with pytest.raises(InputError, match="line 4: time_s 50 stands below 100; sort the rows"):
        load_session(session)


def test_joint_columns_are_called_as_the_format_calls_them(session):
    joints_session(session, ["a,clouds/v000.ply,10,20,30"], "view,cloud,j01_deg,j02_deg,j03_deg")
    with pytest.raises(InputError, match="neither joints \\(j1_deg"):
        load_session(session)


def test_robot_with_another_number_of_joints(session):
    joints_session(session, ["a,clouds/v000.ply,10,20"], "view,cloud,j1_deg,j2_deg")
    with pytest.raises(InputError, match="2 joint columns, but the robot has 3"):
        load_session(session)


def test_real_sessions_are_read(shared_data):
    for name, views in (("reghec/david", 9), ("fanuc-line-sphere", 15), ("irb120-tracker", 600), ("ur10-tmac", 1495)):
        assert len(load_session(shared_data / name).views) == views
