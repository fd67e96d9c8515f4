"""Every command on a session of clouds and labelled points."""

import json

import numpy as np
import pytest

from data_synth.fixtures.drilled_plate import measured_plate
from data_synth.write import write_session


@pytest.mark.slow
def test_every_command_works(tmp_path, stitch_command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    measured = measured_plate(5, views=10)
    write_session(tmp_path / "s", measured, "plate")
    out = tmp_path / "r"
    first = json.loads(stitch_command("run", tmp_path / "s", "-o", out, "--json"))
    assert {t["target"] for t in first["targets"]} == set(measured.targets)
    assert all(np.isfinite(t["sigma"]).all() for t in first["targets"]) and first["outliers"] == []
    assert json.loads(stitch_command("diagnose", out, "--json"))["effects"] is not None
    stitch_command("compare", out)
    second = json.loads(stitch_command("add", out, "joint_offset", "--no-recording", "--json"))
    assert "joint_offset" in second["effects"] and second["targets"]
    assert "Targets" in (tmp_path / "r" / "report.html").read_text()
    judged = json.loads(
        stitch_command("run", tmp_path / "s", "--hand-eye", out, "-o", tmp_path / "q", "--no-recording", "--json")
    )
    assert len(judged["targets"]) == len(first["targets"])
    page = tmp_path / "q" / "report.html"
    targets = [line for line in page.read_text().splitlines() if "reference frame</td>" in line]
    stitch_command("report", tmp_path / "q", "--no-diagnosis")
    assert len(targets) == len(first["targets"]) and all(line in page.read_text() for line in targets)
