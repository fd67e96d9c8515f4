"""Folders that an earlier state of stitch wrote are opened: a run with effects, a rig, a history, a session, an arm."""

import json
import re
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest

import stitch

DATA = Path(__file__).parent / "data"


@pytest.fixture
def earlier(tmp_path) -> Path:
    """The folders, with what they name of each other where they lie now."""
    folder = tmp_path / "earlier"
    shutil.copytree(DATA / "earlier", folder)
    shutil.copytree(DATA / "reghec-rubik", folder / "rubik")
    for file in folder.rglob("result.json"):
        file.write_text(file.read_text(encoding="utf-8").replace("/cells/", f"{folder}/"), encoding="utf-8")
    with sqlite3.connect(folder / "cell" / "history.sqlite") as history:
        history.execute("UPDATE runs SET run = replace(run, '/cells/', ?)", (f"{folder}/",))
        history.execute("UPDATE runs SET session = replace(session, '/cells/', ?)", (f"{folder}/",))
    history.close()
    return folder


def test_a_run_with_an_effect_is_read_with_its_numbers(earlier):
    run = stitch.load_run(earlier / "run-effects")
    stored = json.loads((earlier / "run-effects" / "result.json").read_text(encoding="utf-8"))
    assert list(run.effects) == ["range_scale"]
    np.testing.assert_array_equal(run.model.T_mount, stored["hand_eye"])
    np.testing.assert_allclose(run.model.covariance, stored["hand_eye_covariance"], rtol=1e-12)
    assert run.residual_rms == stored["residual_rms"]


def test_a_run_of_a_rig_goes_on(earlier, stitch_command):
    stitch_command("drop", earlier / "rig" / "monday", "joint_offset", "--no-recording")
    result = json.loads((earlier / "rig" / "monday" / "result.json").read_text(encoding="utf-8"))
    assert not result["effects"]


def test_a_model_of_a_rig_serves_another_session(earlier, stitch_command):
    rig = earlier / "rig" / "monday"
    stitch_command("run", earlier / "tuesday", "--hand-eye", rig, "-o", earlier / "new", "--no-recording")
    given, used = (json.loads((run / "result.json").read_text(encoding="utf-8")) for run in (rig, earlier / "new"))
    np.testing.assert_array_equal(used["hand_eye"], given["hand_eye"])


def test_a_history_of_a_cell_is_read_and_goes_on(earlier, stitch_command):
    cell = earlier / "cell"
    before = json.loads(stitch_command("watch", cell, "--json", "--no-page"))
    points = earlier / "saved" / "points.csv"
    points.write_text(re.sub(r"(?m)(?<=,)(404\.\d+)", lambda z: f"{float(z[0]) + 0.01:.6f}", points.read_text()))
    stitch_command("run", earlier / "saved", "-o", earlier / "third", "--effects", "joint_offset", "--no-recording")
    stitch_command("watch", cell, "--add", earlier / "third")
    after = json.loads(stitch_command("watch", cell, "--json", "--no-page"))
    assert (before["sessions"], after["sessions"]) == (2, 3)


def test_a_saved_session_is_read_as_it_was_written(earlier):
    saved = stitch.load_session(earlier / "saved")
    written = stitch.load_session(earlier / "monday")
    assert saved.names == written.names
    for one, other in zip(saved.views, written.views, strict=True):
        np.testing.assert_allclose(one.T_base_flange, other.T_base_flange, atol=1e-9)


def test_an_exported_arm_is_the_robot_of_a_session(earlier):
    session = earlier / "monday" / "session.toml"
    head = session.read_text(encoding="utf-8").split("[robot]")[0]
    session.write_text(head + (earlier / "arm.toml").read_text(encoding="utf-8"), encoding="utf-8")
    robot = stitch.load_session(earlier / "monday").robot
    nominal = stitch.load_session(earlier / "tuesday").robot
    # The fifth joint is off by 0.3 mrad in the run that the arm was exported from.
    shift = np.subtract(robot.theta, nominal.theta)
    assert abs(shift[4]) == pytest.approx(0.0003, rel=0.2)
