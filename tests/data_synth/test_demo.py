"""What `stitch demo` says; the commands that it runs have tests of their own."""

from types import SimpleNamespace

import pytest

from data_synth import demo as told
from data_synth import made_session, write
from stitch.cli import change, diagnose
from stitch.cli.actions import run_sessions
from stitch.errors import InputError


def test_the_next_command_is_the_last_line_and_the_only_one(tmp_path, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(made_session, "make", lambda *_: SimpleNamespace(clouds=[None] * 3))
    for module, name in ((write, "write_session"), (write, "write_truth"), (change, "add"), (diagnose, "diagnose_run")):
        monkeypatch.setattr(module, name, lambda *_, **options: None)
    monkeypatch.setattr("data_synth.commands.reveal", lambda *_: None)
    monkeypatch.setattr(run_sessions, "run_sessions", lambda sessions, options: asked.append(options))
    told.demo(tmp_path / "demo here")
    lines = capsys.readouterr().err.splitlines()
    assert [options.says_next for options in asked] == [False]
    assert [line for line in lines if "Next:" in line] == [lines[-1]]
    assert lines[-1] == f"Next: stitch review '{tmp_path}/demo here/run'"


def test_a_folder_that_is_no_demo_stays(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("mine")
    with pytest.raises(InputError, match="is not a demo"):
        told.demo(tmp_path / "mine")
    assert (tmp_path / "mine" / "precious.txt").is_file()
