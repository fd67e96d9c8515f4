"""`stitch synth`, `demo` and `reveal`: the same seed gives the same files, mistakes are named, and the judge is fair."""

import json
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth import commands, made_session, nature, scene, write
from data_synth import demo as told
from data_synth.commands import synth
from data_synth.fixtures.edits import edit, replace_text
from data_synth.fixtures.quiet_scenes import clean
from data_synth.judgement import judge
from data_synth.made_session import hidden_of, make, truth_path
from data_synth.simulate import simulate
from data_synth.write import write_session, write_truth
from stitch.cli import change, diagnose, run, terminal
from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.session.reading.session_folder import load_session
from tests.command_line import ended


def test_every_scene_of_the_project_is_read_and_has_a_part():
    assert {"blade", "blade-table", "car-door", "drill-plate", "line-sweep", "panel", "spheres"} <= set(scene.names())
    for name in scene.names():
        assert scene.load_scene(name).name == name


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["warp"], "joint_compliance.*covariate_bias"),
        (["backlash=lots"], "'lots' is not a number"),
        (["backlash=nan"], "not a number"),
        (["backlash=inf"], "not a number"),
    ],
)
def test_unknown_effects_and_amplitudes_are_named(options, says):
    with pytest.raises(InputError, match=says):
        hidden_of(options)


def test_amplitudes():
    assert hidden_of(["backlash", "part_sag=0.5"]) == {"backlash": 1.0, "part_sag": 0.5}


def test_unknown_scene_names_those_there_are():
    with pytest.raises(InputError, match="blade.*spheres"):
        make("nowhere", {}, 0)
    with pytest.raises(InputError, match="no such scene"):
        make("nowhere.toml", {}, 0)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('arm = "KUKA KR30-3"', 'arm = "Puma"', "Puma.*KUKA KR30-3, ABB IRB 120, UR10"),
        ('shape = "sphere"', 'shape = "cube"', "cube.*blade.*sphere_plate"),
        ("tolerance = 0.05", "roundness = 1", "roundness.*radius.*tolerance"),
        ("views = 3", "view = 3", "plan.view; known are .*views"),
        ("columns = 24", "pixels = 24", "scanner.pixels; known are .*columns"),
        ("columns = 24", 'columns = "many"', "scanner.columns"),
        ("columns = 24", 'kind = "radar"', "radar.*area.*line"),
        ("views = 3", 'kind = "dance"', "dance.*turntable.*orbit.*raster"),
        ("views = 3", "views = 1", "plan.views"),
        ('mount = "eye_to_hand"', 'mount = "head"', "head.*eye_to_hand.*eye_in_hand"),
        ('mount = "eye_to_hand"', "", "mount"),
        ("looks = [-0.25, -1.0, 0.1]", "", "scanner.looks"),
        ("looks = [-0.25, -1.0, 0.1]", "looks = [1.0, 0.0]", "scanner.looks"),
        ("[robot]", "[robot]\nlegs = 2", "robot.legs"),
        ("[robot]", "[robot]\nuseful = [9]", "robot.useful"),
        ("[robot]", "[roboter]", "robot"),
        ("[plan]", "[plan", "not valid TOML"),
    ],
)  # fmt: skip
def test_mistakes_in_a_scene_are_named(small, old, new, says):
    replace_text(small, old, new)
    with pytest.raises(InputError, match=says):
        make(small, {}, 0)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["synth", "nowhere", "OUT"], "nowhere: no such scene; to fix: name one of blade"),
        (["synth", "blade", "OUT", "--hide", "warp"], "--hide warp: nature knows range_scale"),
        (["synth", "blade", "OUT", "--seed", "-1"], "--seed -1"),
        (["reveal", "OUT", "truth.json"], "truth.json: not found"),
    ],
)
def test_command_line_ends_in_one_line_and_exit_code_2(arguments, says, tmp_path):
    told = ended(*[str(tmp_path / "out") if a == "OUT" else a for a in arguments], code=2)
    assert list(tmp_path.iterdir()) == []
    lines = told.err.strip().splitlines()
    assert len(lines) == 1 and says in lines[0]


def test_scene_files_hold_no_key_that_is_the_default_by_mistake():
    """A scene says mount, robot and scanner in so many words."""
    for name in scene.names():
        document = tomllib.loads((scene.SCENES / f"{name}.toml").read_text(encoding="utf-8"))
        assert {"mount", "robot", "scanner", "part", "plan"} <= set(document)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_same_seed_same_bytes_another_seed_others(small, tmp_path):
    for place, seed in (("a", 7), ("b", 7), ("c", 8)):
        synth(str(small), tmp_path / place / "s", ["joint_compliance=2", "third_harmonic"], seed)
    a, b, c = (contents(tmp_path / place) for place in "abc")
    assert set(a) == {
        "s/session.toml", "s/views.csv", "s/points.csv", "s/clouds/v000.ply", "s/clouds/v001.ply", "s/clouds/v002.ply",
        "s.truth.json", "s.truth.ply",
    }  # fmt: skip
    assert a == b
    # The part is the same whatever the seed, and so are the arm and the scanner; all that is measured differs.
    assert {name for name in a if a[name] == c[name]} == {"s.truth.ply"}


def test_truth_goes_where_it_is_told(small, tmp_path):
    synth(str(small), tmp_path / "s", ["mount_drift=0.5"], 1, None, tmp_path / "elsewhere" / "t.json")
    assert not truth_path(tmp_path / "s").exists()
    truth = json.loads((tmp_path / "elsewhere" / "t.json").read_text())
    assert (tmp_path / "elsewhere" / "t.ply").is_file()
    assert truth["seed"] == 1 and truth["scene"] == "small" and list(truth["hidden"]) == ["mount_drift"]
    # Nobody who reads the session learns what is hidden.
    session = contents(tmp_path / "s")
    assert not any(b"drift" in data or b"truth" in data for data in session.values())


def test_views_and_labelled_points_follow_the_option(small, tmp_path):
    synth(str(small), tmp_path / "s", [], 1, 4)
    session = load_session(tmp_path / "s")
    assert len(session.views) == 4
    assert session.sphere_radius == 30.0
    rows = (tmp_path / "s" / "points.csv").read_text().splitlines()
    assert rows[0] == "view,target,x,y,z,sigma" and len(rows) == 5


def test_session_can_be_read_back_and_agrees_with_what_was_measured(small, tmp_path):
    measured = make(small, {}, 3)
    write_session(tmp_path / "s", measured, "s")
    session = load_session(tmp_path / "s")
    assert session.mount == "eye_to_hand" and session.robot.n_joints == 6
    for view, cloud, T, q in zip(session.views, measured.clouds, measured.T_base_flange, measured.plan.joints,
                                 strict=True):  # fmt: skip
        assert np.array_equal(view.cloud.points, cloud.points)
        # Twelve digits: 1e-9 of a metre and of a radian.
        assert np.allclose(view.T_base_flange, T, atol=1e-6) and np.allclose(view.joints, q, atol=1e-9)


def test_line_scanner_writes_times_and_velocities(tmp_path):
    line = clean("line-sweep", rays=24)
    measured = simulate(line, {}, 0, 2)
    write_session(tmp_path / "s", measured, "s")
    header = (tmp_path / "s" / "views.csv").read_text().splitlines()[0].split(",")
    assert {f"j{i}_velocity_deg_s" for i in range(1, 8)} <= set(header)
    cloud = load_session(tmp_path / "s").views[0].cloud
    assert np.allclose(cloud.scalars["time"], measured.clouds[0].time, atol=1e-6)


def test_refuses_what_is_there_already(small, tmp_path):
    (tmp_path / "s").mkdir()
    with pytest.raises(InputError, match="exists already"):
        synth(str(small), tmp_path / "s")
    assert list((tmp_path / "s").iterdir()) == []


def test_one_view_is_too_few(small, tmp_path):
    with pytest.raises(InputError, match="--views 1"):
        synth(str(small), tmp_path / "s", [], 0, 1)


def test_a_part_out_of_reach_says_so_and_writes_nothing(small, tmp_path, monkeypatch):
    monkeypatch.setattr("data_synth.planning._ATTEMPTS", 3)
    edit(small, r"xyz = \[1450\.0, ", "xyz = [9000.0, ")
    with pytest.raises(NoResultError, match="view 0 cannot be reached"):
        synth(str(small), tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_truth_must_be_a_json_file(small, tmp_path):
    with pytest.raises(InputError, match=r"truth.ply.*\.json"):
        synth(str(small), tmp_path / "s", [], 0, None, tmp_path / "truth.ply")
    assert not (tmp_path / "s").exists()


def test_truth_is_all_there_is_of_a_hidden_law(small):
    """The quiet laws must not add to a hidden one: its fitted numbers are compared with the truth."""
    for name in nature.SMALL:
        laws, told = nature.draw({name: 1.0}, 1.0, make(small, {}, 0).plan, np.random.default_rng(0))
        assert [p for n, p in laws.laws if n == name] == [told[name]]


def test_write_truth_holds_every_number_a_judge_needs(small, tmp_path):
    measured = make(small, {"backlash": 1.0}, 3)
    write_truth(tmp_path / "t.json", measured, 3)
    truth = json.loads((tmp_path / "t.json").read_text())
    assert np.allclose(truth["hand_eye"], measured.T_mount) and np.allclose(
        truth["poses"], measured.T_reference_scanner
    )
    assert truth["hidden"]["backlash"] and truth["targets"] == {"ball1": [0.0, 0.0, 0.0]}
    # The stated hand-eye is off by what the scene says: 0.3° and 2 mm.
    difference = np.linalg.inv(measured.T_mount) @ measured.T_coarse
    angle = np.degrees(np.arccos((np.trace(difference[:3, :3]) - 1) / 2))
    assert angle == pytest.approx(0.3, rel=1e-6)
    # exp couples the two by half the angle: 2.6e-3 of the length.
    assert np.linalg.norm(difference[:3, 3]) == pytest.approx(2.0, rel=3e-3)


def test_the_next_command_is_the_last_line_and_the_only_one(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(made_session, "make", lambda *_: SimpleNamespace(clouds=[None] * 3))
    for module, name in ((write, "write_session"), (write, "write_truth"), (commands, "reveal")):
        monkeypatch.setattr(module, name, lambda *_: None)
    for module, name in ((run, "run"), (diagnose, "diagnose_run"), (change, "add")):
        monkeypatch.setattr(module, name, lambda *_, **__: terminal.show_next("Next: of this step alone"))
    told.demo(tmp_path / "demo here")
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if "Next:" in line] == [lines[-1]]
    assert lines[-1] == f"Next: stitch review '{tmp_path}/demo here/run'"
    terminal.show_next("Next: again")
    assert capsys.readouterr().err == "Next: again\n"


def test_a_folder_that_is_no_demo_stays(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("mine")
    with pytest.raises(InputError, match="is not a demo"):
        told.demo(tmp_path / "mine")
    assert (tmp_path / "mine" / "precious.txt").is_file()


def test_reveal_prints_json_alone(tmp_path):
    judged(tmp_path, diagnosis=NAMED)
    told = ended("reveal", tmp_path / "run", tmp_path / "truth.json", "--json")
    assert json.loads(told.out)["judgement"] == "right"


def test_people_read_what_was_hidden_once_and_with_units(tmp_path):
    judged(tmp_path, fitted=FITTED, diagnosis={**NAMED, "verdict": "adequate", "effects": []})
    told = ended("reveal", tmp_path / "run", tmp_path / "truth.json").out.split("\n")
    assert [line.split() for line in told[:3]] == [
        ["hidden", "joint_compliance"],
        ["in", "the", "model", "joint_compliance"],
        ["verdict", "adequate"],
    ]
    assert not any(line.strip().startswith("named") for line in told)


NAMED = {"format": "stitch-diagnosis/1", "verdict": "missing_effect", "effects": ["joint_compliance"]}


HIDDEN = {"joint_compliance": {"c2": 1e-6, "c3": 2e-6}}


def judged(tmp_path, hidden=HIDDEN, diagnosis=None, fitted=None, unit="mm", off=0.0) -> dict:
    scale = 1.0 if unit == "mm" else 1e-3
    T = frames.make(np.eye(3), np.array([100.0, 0.0, 500.0]))
    stated = frames.make(np.eye(3), scale * np.array([100.0 + off, 0.0, 500.0]))
    run = tmp_path / "run"
    run.mkdir(exist_ok=True)
    result = {
        "length_unit": unit,
        "hand_eye": stated.tolist(),
        "hand_eye_coarse": stated.tolist(),
        "effects": fitted or {},
    }
    (run / "result.json").write_text(json.dumps(result))
    (run / "diagnosis.json").unlink(missing_ok=True)
    if diagnosis:
        (run / "diagnosis.json").write_text(json.dumps(diagnosis))
    (tmp_path / "truth.json").write_text(json.dumps({"hidden": hidden, "hand_eye": T.tolist()}))
    return judge(run, tmp_path / "truth.json")


FITTED = {"joint_compliance": {"c2": {"value": 1.1e-6, "sigma": 2e-7, "unit": "rad/(N m)"}}}


WHOLE = {"joint_compliance": dict.fromkeys(("c2", "c3"), FITTED["joint_compliance"]["c2"])}
OWN = "humidity_bias: an effect of your own, its name says nothing here; judge it by the hand-eye's error"


@pytest.mark.parametrize(
    ("hidden", "verdict", "named", "fitted", "judgement"),
    [
        (HIDDEN, "missing_effect", ["joint_compliance"], {}, "right"),
        (HIDDEN, "cannot_tell", ["gear_eccentricity", "joint_compliance"], {}, "right: among those that cannot be told apart"),
        (HIDDEN, "missing_effect", ["backlash"], {}, "wrong name"),
        (HIDDEN, "cannot_tell", ["backlash", "settling"], {}, "wrong name"),
        (HIDDEN, "adequate", [], {}, "missed: joint_compliance"),
        (HIDDEN, "unknown_effect", [], {}, "right: something is there"),
        (HIDDEN, None, [], {}, "not found yet: joint_compliance"),
        (HIDDEN, None, [], WHOLE, "complete"),
        (HIDDEN, "adequate", [], WHOLE, "right"),
        (HIDDEN, "unknown_effect", [], WHOLE, "wrong: nothing is left"),
        (HIDDEN, "missing_effect", ["backlash"], WHOLE, "wrong name"),
        (HIDDEN, None, [], FITTED, "complete, but joint_compliance.c3 (true 2e-06) stayed at zero"),
        (HIDDEN, "adequate", [], FITTED, "right, but joint_compliance.c3 (true 2e-06) stayed at zero"),
        (HIDDEN, "unknown_effect", [], FITTED, "right: something is there"),
        ({"covariate_bias": {"k": 0.1}}, "adequate", [], {"humidity_bias": {}}, OWN),
        (HIDDEN, "adequate", [], {"backlash": {}}, "wrong: backlash was added and is not there"),
        ({}, "adequate", [], {}, "right"),
        ({}, "missing_effect", ["backlash"], {}, "wrong name"),
        ({}, "unknown_effect", [], {}, "wrong: nothing is left"),
        ({"third_harmonic": {"A2": 1e-4, "B2": 0.0}}, "unknown_effect", [], {}, "right: something is there"),
        ({"third_harmonic": {"A2": 1e-4, "B2": 0.0}}, "adequate", [], {}, "missed: third_harmonic"),
    ],
)  # fmt: skip
def test_judgement(tmp_path, hidden, verdict, named, fitted, judgement):
    diagnosis = {**NAMED, "verdict": verdict, "effects": named} if verdict else None
    got = judged(tmp_path, hidden, diagnosis, fitted)
    assert got["judgement"] == judgement
    assert got["verdict"] == (verdict or "not diagnosed") and got["named"] == sorted(named)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_judge_measures_the_hand_eye_in_millimetres(tmp_path, unit):
    got = judged(tmp_path, unit=unit, off=0.25, fitted=FITTED)
    assert got["hand_eye_error_mm"] == pytest.approx(0.25, abs=1e-4)
    assert "1.1 ± 0.2 µrad/(N m), true 1 µrad/(N m)" in got["joint_compliance.c2"]
    assert "joint_compliance.c3" not in got


def test_judge_names_files_it_cannot_use(tmp_path):
    judged(tmp_path)
    run, truth = tmp_path / "run", tmp_path / "truth.json"
    with pytest.raises(InputError, match="nowhere.json: not found"):
        judge(run, tmp_path / "nowhere.json")
    truth.write_text("[]")
    with pytest.raises(InputError, match="truth.json"):
        judge(run, truth)
    truth.write_text("{")
    with pytest.raises(InputError, match="not a JSON file"):
        judge(run, truth)
    judged(tmp_path)
    (run / "result.json").write_text("{}")
    with pytest.raises(InputError, match="result.json: length_unit is missing"):
        judge(run, truth)
