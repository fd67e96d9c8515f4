"""run, diagnose, add, compare and drop on a session on disk."""

import json
import shutil
from dataclasses import replace

import pytest

from data_synth.fixtures.quiet_scenes import simulated
from data_synth.judgement import judge
from data_synth.scene import load_scene
from data_synth.write import write_session, write_truth
from stitch.cli.main import main
from stitch.errors import InputError
from stitch.output.stored_run import load_run


@pytest.fixture(scope="module")
def session_on_disk(tmp_path_factory, stitch_command):
    """A folder with a session `s`, what was hidden in it, and a run `r0` of it."""
    folder = tmp_path_factory.mktemp("cli")
    scene = load_scene("blade")
    scene = replace(scene, scanner=replace(scene.scanner, columns=55, rows=55))
    measured = simulated(scene, {"joint_compliance": 3.0}, 0, 10)
    write_session(folder / "s", measured, "s")
    write_truth(folder / "s.truth.json", measured, 0)
    stitch_command("run", folder / "s", "-o", folder / "r0", "--no-recording")
    return folder


@pytest.mark.usefixtures("no_drawing")
def test_the_whole_way_by_command_line(session_on_disk, stitch_command):
    folder = session_on_disk
    shutil.copytree(folder / "r0", folder / "r")
    told = json.loads(stitch_command("diagnose", folder / "r", "--json"))
    assert told["format"] == "stitch-diagnosis/1"
    assert told["effects"] == ["joint_compliance"]
    assert told == json.loads((folder / "r" / "diagnosis.json").read_text())
    keys = {"effect", "p_value", "posterior", "observable", "parameters", "rms_if_added", "heldout_rms_if_added",
            "minimum_detectable", "aliases"}  # fmt: skip
    assert all(keys <= set(c) for c in told["candidates"])
    seen = [c["observable"] for c in told["candidates"]]
    assert seen == sorted(seen, reverse=True)
    stitch_command("add", folder / "r", "joint_compliance", "--no-recording")
    assert not (folder / "r" / "diagnosis.json").exists()
    result = json.loads((folder / "r" / "result.json").read_text())
    assert result["effects"]["joint_compliance"]["c2"]["unit"] == "rad/(N m)"
    ledger = json.loads((folder / "r" / "ledger.json").read_text())
    assert [s["step"] for s in ledger] == [0, 1]
    assert ledger[1]["residual_rms"] < ledger[0]["residual_rms"]
    assert judge(folder / "r", folder / "s.truth.json")["judgement"] == "complete"
    assert load_run(folder / "r").model.terms[0].effect.name == "joint_compliance"


@pytest.mark.slow
@pytest.mark.usefixtures("no_drawing")
def test_a_model_with_an_effect_is_used_compared_and_undone(session_on_disk, stitch_command):
    folder = session_on_disk
    shutil.copytree(folder / "r0", folder / "r", dirs_exist_ok=True)
    stitch_command("add", folder / "r", "joint_compliance", "--no-recording")
    result = json.loads((folder / "r" / "result.json").read_text())
    stitch_command("run", folder / "s", "-o", folder / "again", "--hand-eye", folder / "r", "--no-recording")
    again = json.loads((folder / "again" / "result.json").read_text())
    assert again["residual_rms"] == pytest.approx(result["residual_rms"], rel=0.02)
    stitch_command("compare", folder / "r", "--json")
    assert "Where model and measurement differ" in (folder / "r" / "report.html").read_text()
    stitch_command("drop", folder / "r", "joint_compliance", "--no-recording")
    assert json.loads((folder / "r" / "result.json").read_text())["effects"] == {}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["diagnose", "nowhere"], ["nowhere", "no such run folder"]),
        (["add", "RUN", "elbow"], ["no effect 'elbow'"]),
        (["add", "RUN"], ["--suggested", "--group"]),
        (["add", "RUN", "--suggested", "--group"], ["one of the three"]),
        (["drop", "RUN", "backlash"], ["not in its model"]),
        (["run", "SESSION", "--effects", "elbow"], ["no effect 'elbow'"]),
        (["diagnose", "RUN", "--effects-file", "mine.py"], ["mine.py", "no such file"]),
        (["effects", "elbow"], ["no effect 'elbow'"]),
    ],
)
def test_bad_use_ends_in_one_line(session_on_disk, capsys, arguments, words):
    folder = session_on_disk
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        main([a.replace("RUN", str(folder / "r0")).replace("SESSION", str(folder / "s")) for a in arguments])
    assert stop.value.code == 2
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    assert all(word in line for word in words)


def test_state_of_a_vanished_session_is_refused(tmp_path, session_on_disk):
    folder = session_on_disk
    document = json.loads((folder / "r0" / "result.json").read_text())
    document["session"] = str(tmp_path / "gone")
    (tmp_path / "r").mkdir()
    for name in ("model.toml", "ledger.json"):
        (tmp_path / "r" / name).write_text((folder / "r0" / name).read_text())
    (tmp_path / "r" / "result.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="has gone"):
        load_run(tmp_path / "r")
