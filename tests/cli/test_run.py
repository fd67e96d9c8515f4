"""Runs at the command line: exit codes, folders that stay as they are, every kind of session, and what cannot be written.

`stitch check --deep`: its JSON stands on standard output whatever is wrong, one object a session.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.drilled_plate import measured_plate
from data_synth.fixtures.labelled_arm import (
    labelled_cell,
)
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.write import write_session
from stitch.cli.main import build
from stitch.system.files import rewrite_folder, whole_file
from tests.command_line import ended

KINDS = {
    "exchanged", "shifted", "reversed", "inverse", "mount", "euler", "degrees", "quaternion", "unit", "scale",
    "mirrored", "joint_row", "duplicate_scan", "duplicate_pose", "displaced", "foreign", "reclamped", "disconnected",
}  # fmt: skip


def test_check_reads_all_and_reports_each(session):
    told = ended("check", session, session / "nowhere", "--json", code=2)
    document = json.loads(told.out)
    assert document["sessions"][0]["views"] == 3
    assert "nowhere" in document["errors"][0]


def test_usage_is_exit_2():
    for arguments in (["run"], ["run", "x", "--no-such-option"], ["fly"]):
        ended(*arguments, code=2)


def test_an_existing_folder_that_is_no_run_is_not_touched(session, tmp_path):
    keep = tmp_path / "mine"
    keep.mkdir()
    (keep / "thesis.txt").write_text("all of it")
    ended("run", session, "-o", keep, code=2)
    assert [path.name for path in keep.iterdir()] == ["thesis.txt"]


def test_a_run_cannot_take_the_place_of_the_folder_one_stands_in(session, tmp_path, monkeypatch):
    monkeypatch.setattr("stitch.api.pipeline.run_rig", lambda *_: pytest.fail("computed first"))
    (tmp_path / "here" / "inner").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "inner")
    for target in (".", "..", tmp_path / "here" / "inner"):
        told = ended("run", session, "-o", target, code=2)
        assert f"stitch: {target}: " in told.err
    assert sorted(path.name for path in tmp_path.rglob("here/**/*")) == ["inner"]


def test_a_batch_of_sessions_that_cannot_be_read_is_bad_input(tmp_path):
    told = ended("batch", tmp_path / "nowhere", "-o", tmp_path / "runs", code=2)
    assert "nowhere" in told.err


@pytest.mark.parametrize(
    ("size", "said"),
    [
        ("much", "--memory much: to fix: give a size such as 2GB"),
        ("nan", "--memory nan: to fix"),
        ("1GB", r"memory: 1 GB are too little for a run of 3 views; to fix: give 1\.3 GB"),
        ("900 MiB", "memory: 0.9 GB are too little"),
    ],
)
def test_memory_that_is_no_size_or_too_little_is_refused(session, tmp_path, size, said):
    told = ended("run", session, "-o", tmp_path / "r", "--memory", size, code=2)
    assert re.search(said, told.err)
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("words", "sessions", "kind"),
    [
        ("--mesh blade-17", ["blade-17"], "open"),
        ("blade-17 --mesh", ["blade-17"], "open"),
        ("--mesh watertight blade-17", ["blade-17"], "watertight"),
        ("blade-17 --mesh light --json", ["blade-17"], "light"),
        ("blade-17 --mesh=light", ["blade-17"], "light"),
        ("watertight", ["watertight"], None),
    ],
)
def test_a_mesh_may_be_of_a_kind_and_takes_no_session_for_one(words, sessions, kind):
    command = typer.main.get_command(build()).commands["run"]
    context = command.make_context("run", words.split())
    assert [str(path) for path in context.params["sessions"]] == sessions and context.params["mesh"] == kind


def test_a_mesh_for_which_open3d_is_missing_is_refused_before_the_work(session, tmp_path, monkeypatch):
    monkeypatch.setattr("stitch.api.pipeline.run_rig", lambda *_: pytest.fail("computed first"))
    monkeypatch.setitem(sys.modules, "open3d", None)
    told = ended("run", session, "-o", tmp_path / "run", "--mesh", "watertight", code=2)
    missing = "stitch: --mesh watertight: Open3D is not installed; to fix: pip install 'stitch-scans[open3d]'"
    assert missing in told.err
    told = ended("run", session, "-o", tmp_path / "run", "--mesh=smooth", code=2)
    assert "--mesh smooth: to fix" in told.err
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize("kind", ["points", pytest.param("frames", marks=pytest.mark.slow)])
def test_every_command_works_on_a_session_of_labelled_points(kind, tmp_path, stitch_command, monkeypatch, few_effects):
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
    second = json.loads(stitch_command("add", out, "joint_offset", "--no-recording", "--json"))
    assert second["heldout_rms"] < first["heldout_rms"]
    # The model of one run judges other poses of the rig without fitting anything.
    other, *_ = labelled_cell(2, views=24, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]), probe=kind == "frames")
    evaluate = json.loads(
        stitch_command(
            "run",
            write_labelled(tmp_path / "o", other, kind),
            "--hand-eye",
            out,
            "-o",
            tmp_path / "q",
            "--no-recording",
            "--json",
        )
    )
    assert (
        evaluate["hand_eye"] == second["hand_eye"]
        and evaluate["targets"][0]["position"] == second["targets"][0]["position"]
    )
    assert evaluate["targets"][0]["sigma"] == second["targets"][0]["sigma"]
    assert evaluate["residual_rms"] == pytest.approx(second["residual_rms"], rel=0.05)
    stitch_command("drop", out, "joint_offset", "--no-recording")
    stitch_command("add", out, "--suggested", "--no-recording")
    assert "joint_offset" in json.loads((tmp_path / "r" / "result.json").read_text())["effects"]
    stitch_command("report", out, "--no-diagnosis")
    assert "Targets" in (tmp_path / "r" / "report.html").read_text()


def test_a_member_of_a_rig_that_is_changed_says_that_the_others_are_not(tmp_path, stitch_command):
    folders = [
        write_labelled(tmp_path / name, labelled_cell(seed, views=16, offset=np.array([0, 1e-3, 0, 0, 2e-3, 0]))[0])
        for seed, name in enumerate("abc")
    ]
    stitch_command("run", *folders, "-o", tmp_path / "rig", "--no-recording")
    said = " ".join(stitch_command("add", tmp_path / "rig" / "b", "joint_offset", "--no-recording").split())
    assert "this run alone has changed: a, c and their common model.toml are as they were" in said
    assert "with all sessions --effects joint_offset and -o" in said
    stitch_command("run", folders[0], "-o", tmp_path / "alone", "--no-recording")
    said = stitch_command("add", tmp_path / "alone", "joint_offset", "--no-recording")
    assert "alone has changed" not in " ".join(said.split())


@pytest.mark.slow
def test_every_command_works_on_a_session_of_clouds_and_labelled_points(tmp_path, stitch_command, monkeypatch):
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


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="nobody may make a folder in /proc")
def test_the_folder_that_was_asked_for_is_named(session):
    told = ended("run", session, "-o", "/proc/xx", code=2)
    assert told.err.strip().startswith("stitch: /proc/xx: No such file or directory; to fix: name")


def test_the_file_that_was_asked_for_is_named(tmp_path):
    asked = tmp_path / "nowhere" / "diagnosis.json"
    with pytest.raises(OSError) as error, whole_file(asked) as scratch:
        scratch.write_text("")
    assert error.value.filename == str(asked)


def test_an_error_at_another_file_keeps_its_name(tmp_path):
    other = tmp_path / "nowhere" / "other"
    with pytest.raises(OSError) as error, whole_file(tmp_path / "a") as scratch:
        scratch.write_text("")
        other.write_text("")
    assert error.value.filename == str(other)


def test_a_scratch_folder_that_cannot_be_made_names_the_folder(tmp_path, monkeypatch):
    def refused(path, *arguments):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.chdir(tmp_path)
    Path("run").mkdir()
    monkeypatch.setattr("tempfile._os.mkdir", refused)
    with pytest.raises(PermissionError) as error, rewrite_folder(Path("run"), lambda inside: True):
        pass
    assert error.value.filename == "run"


def test_a_reader_that_has_seen_enough_loses_no_run(session, tmp_path):
    command = [sys.executable, "-P", "-m", "stitch", "run", str(session), "-o", "run", "--no-recording"]
    run = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert run.stdout is not None and run.stderr is not None
    run.stdout.close()  # as `| head -0` does
    said = run.stderr.read()
    assert run.wait() == 0, said
    assert (tmp_path / "run" / "model.toml").is_file()


def test_two_sessions_of_scans_are_run_with_their_recordings_and_diagnosed_together(tmp_path, stitch_command):
    names = ("monday", "tuesday")
    for seed, name in enumerate(names):
        write_session(tmp_path / name, measured_blade(seed, views=5, pixels=50), name)
    stitch_command("run", *(tmp_path / name for name in names), "-o", tmp_path / "rig")
    assert {path.parent.name for path in (tmp_path / "rig").glob("*/recording.rrd")} == set(names)
    assert "together: they show no effect of their arm" in stitch_command("diagnose", tmp_path / "rig")


def test_a_run_is_replaced_and_diagnosed_where_no_open_file_can_be_removed(session, tmp_path):
    windows = Path(__file__).parents[1] / "as_on_windows.py"
    # Text without a stated encoding is an error, and the terminal knows the letters of Western Europe only.
    strict = {
        "PYTHONIOENCODING": "cp1252",
        "PYTHONWARNDEFAULTENCODING": "1",
        "PYTHONWARNINGS": "error::EncodingWarning",
    }
    for words in (["run", session, "-o", "out"], ["run", session, "-o", "out"], ["diagnose", "out"]):
        command = [sys.executable, windows, *map(str, words)]
        done = subprocess.run(command, cwd=tmp_path, env=os.environ | strict, capture_output=True, encoding="cp1252")
        assert done.returncode == 0, done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"out", session.name}
    assert (tmp_path / "out" / "diagnosis.json").is_file()


@pytest.fixture
def in_metres(session, tmp_path):
    """The simulated cell with clouds whose unit is stated a thousand times too large."""
    folder = shutil.copytree(session, tmp_path / "metres")
    file = folder / "session.toml"
    file.write_text('cloud_unit = "m"\n' + file.read_text(encoding="utf-8"), encoding="utf-8")
    return folder


def deep(*folders):
    """What check --deep says of sessions of which one at least cannot be right."""
    told = ended("check", "--deep", *folders, "--json", code=2)
    return json.loads(told.out), told.err


def test_a_unit_that_cannot_be_is_a_problem_as_any_other(in_metres):
    told, _ = deep(in_metres)
    assert told["ok"] is False
    (problem,) = told["problems"]
    assert problem["kind"] == "unit" and problem["kind"] in KINDS and problem["views"] == []
    assert "cloud_unit" in problem["fix"] and "\n" not in problem["fix"]


def test_one_cloud_in_another_unit_is_named(session, tmp_path):
    folder = shutil.copytree(session, tmp_path / "one")
    cloud = sorted((folder / "clouds").iterdir())[1]
    cloud.write_text("".join(f"{x} {y} 400000\n" for x in range(0, 90000, 3000) for y in range(0, 90000, 3000)))
    views = folder / "views.csv"
    cloud = cloud.rename(cloud.with_suffix(".xyz"))
    views.write_text(views.read_text(encoding="utf-8").replace(f"{cloud.stem}.ply", cloud.name), encoding="utf-8")
    told, _ = deep(folder)
    assert [(p["kind"], p["views"]) for p in told["problems"]] == [("unit", [cloud.stem])]


def test_a_session_that_cannot_be_read_hides_no_other(in_metres, tmp_path):
    told, err = deep(tmp_path / "nowhere", in_metres)
    assert [row["ok"] for row in told] == [False, False]
    assert told[0]["problems"] == [] and "not found" in told[0]["errors"][0] and "not found" in err
    assert told[1]["problems"][0]["kind"] == "unit"
