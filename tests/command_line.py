"""The command line as tests call it: what it prints, held against the exit code that is right."""

import io
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

import pytest

from stitch.cli.main import main


class Ended(NamedTuple):
    """What a command printed."""

    out: str
    err: str


def ended(*words: object, code: int = 0) -> Ended:
    """Run a command, of which the exit code must be this one."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    assert (stop.value.code or 0) == code, err.getvalue()
    return Ended(out.getvalue(), err.getvalue())
