"""check, run and batch: exit codes, and folders that stay as they are."""

import json
import re
import sys

import pytest
import typer

from stitch.cli.main import build, main


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
    monkeypatch.setattr("stitch.api.pipeline.run_rig", lambda *_: pytest.fail("computed first"))
    (tmp_path / "here" / "inner").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "inner")
    for target in (".", "..", tmp_path / "here" / "inner"):
        with pytest.raises(SystemExit) as ended:
            main(["run", str(session), "-o", str(target)])
        assert ended.value.code == 2
        assert f"stitch: {target}: " in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.rglob("here/**/*")) == ["inner"]


def test_a_batch_of_sessions_that_cannot_be_read_is_bad_input(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["batch", str(tmp_path / "nowhere"), "-o", str(tmp_path / "runs")])
    assert ended.value.code == 2
    assert "nowhere" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("size", "said"),
    [
        ("much", "--memory much: to fix: give a size such as 2GB"),
        ("nan", "--memory nan: to fix"),
        ("1GB", r"memory: 1 GB are too little for a run of 3 views; to fix: give 1\.3 GB"),
        ("900 MiB", "memory: 0.9 GB are too little"),
    ],
)
def test_memory_that_is_no_size_or_too_little_is_refused(session, tmp_path, capsys, size, said):
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "-o", str(tmp_path / "r"), "--memory", size])
    assert ended.value.code == 2
    assert re.search(said, capsys.readouterr().err)
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


def test_a_mesh_for_which_open3d_is_missing_is_refused_before_the_work(session, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("stitch.api.pipeline.run_rig", lambda *_: pytest.fail("computed first"))
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "-o", str(tmp_path / "run"), "--mesh", "watertight"])
    assert ended.value.code == 2
    assert "stitch: --mesh watertight: Open3D is not installed; to fix: pip install open3d" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "-o", str(tmp_path / "run"), "--mesh=smooth"])
    assert ended.value.code == 2 and "--mesh smooth: to fix" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
