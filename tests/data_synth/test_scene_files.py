"""Scenes and options of `stitch synth`: what is there, and mistakes that are named."""

import tomllib

import pytest

from data_synth import scene
from data_synth.made_session import hidden_of, make
from stitch.cli.main import main
from stitch.errors import InputError


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
    text = small.read_text()
    assert old in text
    small.write_text(text.replace(old, new, 1))
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
def test_command_line_ends_in_one_line_and_exit_code_2(arguments, says, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "out") if a == "OUT" else a for a in arguments])
    assert ended.value.code == 2 and list(tmp_path.iterdir()) == []
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and says in lines[0]


def test_scene_files_hold_no_key_that_is_the_default_by_mistake():
    """A scene says mount, robot and scanner in so many words."""
    for name in scene.names():
        document = tomllib.loads((scene.SCENES / f"{name}.toml").read_text(encoding="utf-8"))
        assert {"mount", "robot", "scanner", "part", "plan"} <= set(document)
