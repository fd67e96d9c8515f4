"""`stitch reveal`: the judge is fair."""

import json

import numpy as np
import pytest

from data_synth.judgement import judge
from stitch.cli.main import main
from stitch.errors import InputError


def test_reveal_prints_json_alone(tmp_path, capsys):
    judged(tmp_path, diagnosis=NAMED)
    with pytest.raises(SystemExit) as ended:
        main(["reveal", str(tmp_path / "run"), str(tmp_path / "truth.json"), "--json"])
    assert ended.value.code == 0
    assert json.loads(capsys.readouterr().out)["judgement"] == "right"


def test_people_read_what_was_hidden_once_and_with_units(tmp_path, capsys):
    judged(tmp_path, fitted=FITTED, diagnosis={**NAMED, "verdict": "adequate", "effects": []})
    with pytest.raises(SystemExit):
        main(["reveal", str(tmp_path / "run"), str(tmp_path / "truth.json")])
    told = capsys.readouterr().err.split("\n")
    assert [line.split() for line in told[:3]] == [
        ["hidden", "joint_compliance"],
        ["in", "the", "model", "joint_compliance"],
        ["verdict", "adequate"],
    ]
    assert not any(line.strip().startswith("named") for line in told)


NAMED = {"format": "stitch-diagnosis/1", "verdict": "missing_effect", "effects": ["joint_compliance"]}


HIDDEN = {"joint_compliance": {"c2": 1e-6, "c3": 2e-6}}


def judged(tmp_path, hidden=HIDDEN, diagnosis=None, fitted=None, unit="mm", off=0.0) -> dict:
    T = np.eye(4)
    T[:3, 3] = [100.0, 0.0, 500.0]
    found = T.copy()
    found[0, 3] += off
    scale = 1.0 if unit == "mm" else 1e-3
    stated = found.copy()
    stated[:3, 3] *= scale
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
        ({"knock": {"v": 5.0}}, "adequate", [], {}, "missed: knock"),
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
