"""What `stitch demo` says; the commands that it runs have tests of their own."""

from types import SimpleNamespace

import pytest

from data_synth import commands, made_session, write
from data_synth import demo as told
from stitch.cli import change, diagnose, run, terminal
from stitch.errors import InputError


def test_the_next_command_is_the_last_line_and_the_only_one(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(made_session, "make", lambda *_: SimpleNamespace(clouds=[None] * 3))
    for module, name in ((write, "write_session"), (write, "write_truth"), (commands, "reveal")):
        monkeypatch.setattr(module, name, lambda *_: None)
    for module, name in ((run, "run"), (diagnose, "diagnose_run"), (change, "add")):
        monkeypatch.setattr(module, name, lambda *_, **__: terminal.show_next("Next: of this step alone"))
    told.demo(tmp_path / "demo here")
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if "Next:" in line] == [lines[-1]]
    assert lines[-1] == f"Next: stitch review '{tmp_path}/demo here/run'"
    terminal.show_next("Next: again")
    assert capsys.readouterr().err == "Next: again\n"


def test_a_folder_that_is_no_demo_stays(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("mine")
    with pytest.raises(InputError, match="is not a demo"):
        told.demo(tmp_path / "mine")
    assert (tmp_path / "mine" / "precious.txt").is_file()
