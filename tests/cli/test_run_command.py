"""check, run and batch: exit codes, and folders that stay as they are."""

import json
import shutil

import pytest

from data_synth.fixtures.edits import edit
from stitch.cli.main import main
from stitch.pipeline import run


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
    monkeypatch.setattr("stitch.cli.run.run_rig", lambda *_: pytest.fail("computed first"))
    (tmp_path / "here" / "inner").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "inner")
    for target in (".", "..", tmp_path / "here" / "inner"):
        with pytest.raises(SystemExit) as ended:
            main(["run", str(session), "-o", str(target)])
        assert ended.value.code == 2
        assert f"stitch: {target}: " in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.rglob("here/**/*")) == ["inner"]


def test_a_batch_goes_on_after_whatever_befalls_one_session(session, tmp_path, monkeypatch, capsys):
    """Also after an error that nobody foresaw."""
    shutil.copytree(session, tmp_path / "t")

    edit(tmp_path / "t" / "session.toml", "(?m)^name = .*$", 'name = "second"')

    def fails_once(loaded, recorder):
        if loaded.path.name == "s":
            raise ZeroDivisionError("by\nzero")
        return run(loaded, recorder=recorder)

    monkeypatch.setattr("stitch.cli.batch.run", fails_once)
    with pytest.raises(SystemExit) as ended:
        main(["batch", str(session), str(tmp_path / "t"), "-o", str(tmp_path / "runs"), "--json"])
    assert ended.value.code == 1
    bad, good = json.loads(capsys.readouterr().out)
    assert bad["error"] == "ZeroDivisionError: by zero" and good["error"] is None
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["second"]
    assert {"result.json", "recording.rrd"} <= {path.name for path in (tmp_path / "runs" / "second").iterdir()}


def test_a_batch_of_sessions_that_cannot_be_read_is_bad_input(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["batch", str(tmp_path / "nowhere"), "-o", str(tmp_path / "runs")])
    assert ended.value.code == 2
    assert "nowhere" in capsys.readouterr().err
