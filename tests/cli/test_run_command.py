"""check, run and batch: exit codes, and folders that stay as they are."""

import json

import pytest

from stitch.cli.main import main


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
    monkeypatch.setattr("stitch.cli.actions.run_sessions.run_rig", lambda *_: pytest.fail("computed first"))
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
