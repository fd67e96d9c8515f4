"""Every command on sessions of labelled points and of frames."""

import json

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import (
    labelled_cell,
)
from data_synth.fixtures.labelled_files import write_labelled


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize("kind", ["points", pytest.param("frames", marks=pytest.mark.slow)])
def test_every_command_works(kind, tmp_path, stitch_command, monkeypatch, few_effects):
    monkeypatch.chdir(tmp_path)
    session, *_ = labelled_cell(2, views=24, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]), probe=kind == "frames")
    folder, out = write_labelled(tmp_path / "s", session, kind), tmp_path / "r"
    assert json.loads(stitch_command("check", folder, "--json"))["sessions"][0]["targets"] == (
        4 if kind == "points" else 1
    )
    first = json.loads(stitch_command("run", folder, "-o", out, "--json"))
    assert first["targets"] and first["rms_of"].startswith("3D")
    stitch_command("compare", out)
    assert json.loads(stitch_command("diagnose", out, "--json"))["effects"]
    stitch_command("next", out)
    second = json.loads(stitch_command("add", out, "joint_offset", "--json"))
    assert second["heldout_rms"] < first["heldout_rms"]
    # The model of one run judges other poses of the rig without fitting anything.
    other, *_ = labelled_cell(2, views=24, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]), probe=kind == "frames")
    evaluate = json.loads(
        stitch_command(
            "run", write_labelled(tmp_path / "o", other, kind), "--hand-eye", out, "-o", tmp_path / "q", "--json"
        )
    )
    assert (
        evaluate["hand_eye"] == second["hand_eye"]
        and evaluate["targets"][0]["position"] == second["targets"][0]["position"]
    )
    assert evaluate["targets"][0]["sigma"] == second["targets"][0]["sigma"]
    assert evaluate["residual_rms"] == pytest.approx(second["residual_rms"], rel=0.05)
    stitch_command("drop", out, "joint_offset")
    stitch_command("add", out, "--suggested", "--no-recording")
    assert "joint_offset" in json.loads((tmp_path / "r" / "result.json").read_text())["effects"]
    stitch_command("report", out, "--no-diagnosis")
    assert "Targets" in (tmp_path / "r" / "report.html").read_text()


def test_a_member_of_a_rig_that_is_changed_says_that_the_others_are_not(tmp_path, stitch_command, capsys):
    folders = [
        write_labelled(tmp_path / name, labelled_cell(seed, views=16, offset=np.array([0, 1e-3, 0, 0, 2e-3, 0]))[0])
        for seed, name in enumerate("abc")
    ]
    stitch_command("run", *folders, "-o", tmp_path / "rig", "--no-recording")
    stitch_command("add", tmp_path / "rig" / "b", "joint_offset", "--no-recording")
    said = " ".join(capsys.readouterr().err.split())
    assert "this run alone has changed: a, c and their common model.toml are as they were" in said
    assert "with all sessions --effects joint_offset and -o" in said
    stitch_command("run", folders[0], "-o", tmp_path / "alone", "--no-recording")
    capsys.readouterr()
    stitch_command("add", tmp_path / "alone", "joint_offset", "--no-recording")
    assert "alone has changed" not in " ".join(capsys.readouterr().err.split())
