"""Errors speak the caller's language: what to type, and what to write in a program."""

import pickle

import pytest

from stitch.cli.main import main
from stitch.errors import InputError, NoResultError, did_you_mean


def test_one_fix_in_the_message_serves_both_callers():
    error = InputError("views.csv line 3: no scan v7.ply; to fix: add it")
    assert str(error) == error.command_line == "views.csv line 3: no scan v7.ply; to fix: add it"
    assert error.what == "views.csv line 3: no scan v7.ply"
    assert error.fix_cli == error.fix_python == "add it"


def test_two_fixes_are_told_to_their_callers_alone():
    error = NoResultError("hand-eye: not seen", fix_cli="state --hand-eye RUN", fix_python="pass model=run")
    assert str(error) == "hand-eye: not seen; to fix: pass model=run"
    assert error.command_line == "hand-eye: not seen; to fix: state --hand-eye RUN"


def test_a_message_without_a_fix_is_only_itself():
    assert str(InputError("nothing")) == InputError("nothing").command_line == "nothing"


def test_what_an_error_says_survives_a_process_pool():
    error = InputError("a", fix_cli="b", fix_python="c")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.command_line, vars(again)) == (str(error), error.command_line, vars(error))


@pytest.mark.parametrize(
    ("written", "meant"),
    [("rangescale", "range_scale"), ("Range-Scale", "range_scale"), ("range_scal", "range_scale")],
)
def test_a_name_that_is_nearly_right_is_named(written, meant):
    assert did_you_mean(written, ["joint_offsets", "range_scale"]) == f"; did you mean {meant!r}?"


def test_a_name_that_is_like_none_suggests_none():
    assert did_you_mean("xyz", ["joint_offsets", "range_scale"]) == ""


def test_the_command_line_prints_the_fix_to_type(capsys, monkeypatch):
    def fails(*_):
        raise InputError("there already", fix_cli="state --force", fix_python="pass force=True")

    monkeypatch.setattr("stitch.cli.main.build", lambda: fails)
    with pytest.raises(SystemExit) as end:
        main([])
    assert end.value.code == 2
    assert capsys.readouterr().err.strip() == "stitch: there already; to fix: state --force"
