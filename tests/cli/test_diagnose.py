"""run, diagnose, add, compare and drop on a session on disk.

What stitch compare says: whether anything is clear, every table once, and what to type next.

`stitch next`: what its JSON says, and what is said where nothing has to be told apart.

Whether an effect earned its place, where the held-out residual did not fall.
"""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth.fixtures.quiet_scenes import simulated
from data_synth.judgement import judge
from data_synth.scene import load_scene
from data_synth.write import write_session, write_truth
from stitch.cli.change import remarks
from stitch.cli.compare import show_comparison
from stitch.cli.next_view import next_view_row, write_program
from stitch.errors import InputError
from stitch.output.stored_run import load_run
from tests.command_line import ended
from tests.output.comparison.compared_views import compared

STATE = SimpleNamespace(
    session=SimpleNamespace(length_unit="mm", mount="eye_in_hand"),
    measurement=SimpleNamespace(capture=SimpleNamespace(scans=[1])),
)
POSE = {"do": "take a view", "separates": ["a", "b"], "joints_deg": [1.0, 2.0], "views": 1, "T_base_flange": [[1.0]]}
ARTEFACT = {"do": "scan a sphere", "separates": ["a", "b"], "joints_deg": None, "views": None, "T_base_flange": None}


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


@pytest.mark.usefixtures("no_drawing", "few_effects")
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
    line = ended(
        *[a.replace("RUN", str(folder / "r0")).replace("SESSION", str(folder / "s")) for a in arguments], code=2
    ).err.strip()
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


def said(errors, properties, run, capsys):
    """What is printed of views that are off by `errors` (V,) in mm, as one line without the frames of tables."""
    show_comparison(compared(errors, properties, 0.03), STATE, run)
    return " ".join(capsys.readouterr().err.split())


def test_seven_clean_views_show_nothing_clear_and_every_table_once(tmp_path, capsys):
    errors = np.array([-11.7, 1.5, 13.8, 16.0, -12.4, -7.2, 0.0]) * 1e-3
    j3 = np.array([-51.5, -38.8, -24.0, 6.7, 23.1, 49.8, 56.9])
    told = said(errors, {"j3": j3, "torque 3_3": 2 * j3}, tmp_path, capsys)
    assert "Single points follow nothing clear: chance makes one of" in told
    assert "By j3 (deg); torque 3_3 has the same bins: p = " in told and " over all means, not clear" in told
    assert told.count("By ") == 1
    assert told.endswith(f"Next: stitch diagnose {tmp_path}")


def test_what_is_off_with_the_approach_is_called_clear(tmp_path, capsys):
    (tmp_path / "diagnosis.json").write_text("{}")
    approach = np.resize([-1.0, 1.0], 12)
    errors = 0.03 * approach + np.resize([0.004, 0.004, -0.004, -0.004], 12)
    told = said(errors, {"approach of j3": approach, "j1": np.arange(12.0) % 7}, tmp_path, capsys)
    assert "Single points, clear among" in told and "means of bins: approach of j3 (p < 0.0001)." in told
    assert "nothing clear" not in told
    assert told.endswith(f"Next: stitch review {tmp_path}")


def test_two_views_say_that_they_are_too_few(tmp_path, capsys):
    told = said(np.array([0.02, -0.02]), {"j1": np.array([0.0, 9.0])}, tmp_path, capsys)
    assert "Nothing clear: the views are too few" in told and "p = 1 over all means, not clear" in told


def test_the_json_has_poses_rivals_expectations_and_the_odds_of_all_poses():
    first = POSE | {"wait_s": 0.0, "probability": 0.4}
    second = POSE | {"wait_s": 600.0, "probability": 0.8}
    expected = [{"effect": "a", "value": 1e-4, "sigma": 2e-5}]
    document = {"next": [first, second, ARTEFACT], "screen": {"deciding_view": {"expected": expected}}}
    told = next_view_row(document)
    assert [pose["joints_deg"] for pose in told["poses"]] == [[1.0, 2.0], [1.0, 2.0]]
    assert told["splits"] == ["a", "b"] and told["expected"] == expected
    assert told["probability_to_decide"] == 0.8


def test_without_a_pose_there_are_no_odds_and_no_program(tmp_path):
    told = next_view_row({"next": [ARTEFACT], "screen": None})
    assert told == {"poses": [], "splits": ["a", "b"], "expected": [], "probability_to_decide": None}
    assert next_view_row({"next": [], "screen": None})["splits"] == []

    class Diagnosis:
        next = ()

    with pytest.raises(InputError, match="no pose is proposed"):
        write_program(Diagnosis(), tmp_path / "next.src", None)
    assert not (tmp_path / "next.src").exists()


def with_effect(sigmas: float, heldout: float) -> SimpleNamespace:
    """A run to which an effect was added that is so many sigmas from zero, and what it left held out (1.0 before)."""
    parameter = SimpleNamespace(
        name="a", value=sigmas, sigma=1.0, fitted=True, held=False, beyond_belief=lambda value, sigma: False
    )
    steps = (SimpleNamespace(effects=(), heldout_rms=1.0), SimpleNamespace(effects=("settling",), heldout_rms=heldout))
    return SimpleNamespace(
        ledger=steps,
        terms=(SimpleNamespace(name="settling", parameters=(parameter,), sigmas_from_zero=sigmas, is_geometry=False),),
    )


@pytest.mark.parametrize(
    ("sigmas", "heldout", "said"),
    [
        (9.0, 0.5, None),
        (9.0, 1.01, "9 sigmas from zero, but too small"),
        (3.8, 1.01, "did not fall, and the clearest number is 3.8 sigmas"),
        (3.8, 1.2, "residual rose, and"),
        (1.0, 1.01, "did not earn a place"),
    ],
)
def test_a_residual_that_does_not_fall_condemns_only_what_is_not_seen(sigmas, heldout, said):
    told = [line for line in remarks(with_effect(sigmas, heldout)) if "dropped" not in line]
    assert told == [] if said is None else said in told[0]
