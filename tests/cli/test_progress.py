"""What others may read of the work: a changing line, plain lines, lines of JSON, remarks in the ledger, values in compare.json."""

import json
import os
import pty
import re
import shutil
import subprocess
import sys
import time
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

from stitch.cli import progress as live_line
from stitch.cli.progress import TimeLeft, time_left_text
from stitch.errors import InputError
from stitch.system import process
from stitch.system.process import steps, watched
from stitch.system.threads import parallel
from tests.command_line import ended


@pytest.fixture
def said(monkeypatch):
    """What a terminal would show; the clock moves by a second whenever it is read."""
    out, clock = [], count()

    class Line:
        say = staticmethod(lambda text, step: out.append(text))
        stop = loops_ended = staticmethod(lambda: out.append(""))

    monkeypatch.setattr(live_line, "live_line", Line)
    # Its own name for the clock: other threads read the real one meanwhile.
    monkeypatch.setattr(live_line, "time", SimpleNamespace(monotonic=lambda: float(next(clock))))
    return out


@pytest.mark.parametrize(
    ("done", "seconds", "text"),
    [
        (0, 5.0, None),  # nobody knows yet
        (1, 0.4, None),  # it may be over before anybody has read it
        (10, 30.0, "scans: 10 of 40, 1:30 left"),
        (39, 390.0, "scans: 39 of 40, 0:10 left"),
        (40, 400.0, None),
    ],
)
def test_time_left_is_that_of_the_steps_before(done, seconds, text):
    assert time_left_text("scans", done, 40, seconds) == text


def test_loops_within_loops_are_told_together(said):
    with watched(TimeLeft()):
        for _ in steps("sessions", range(3)):
            assert list(parallel(abs, [-1, -2, -3], "scans")) == [1, 2, 3]
    assert said[3] == "sessions: 1 of 3, 0:10 left"
    assert any(text.startswith("sessions: 2 of 3") and "; scans: 2 of 3, " in text for text in said)
    assert said[-1] == ""  # the line is cleared


def test_no_step_is_counted_where_nobody_watches(said):
    assert list(steps("scans", (i for i in range(3)))) == [0, 1, 2] and list(steps("scans", [1, 2])) == [1, 2]
    assert not said


def test_a_block_that_lasts_says_what_it_does_and_a_short_one_nothing(monkeypatch, capsys):
    monkeypatch.setattr(process, "QUIET", 0.02)
    monkeypatch.delenv("STITCH_PROGRESS", raising=False)
    with process.tell_seconds("fit"):
        until = time.monotonic() + 60
        while not (told := capsys.readouterr().err) and time.monotonic() < until:
            time.sleep(0.02)
    monkeypatch.setattr(process, "QUIET", 60.0)
    with process.tell_seconds("seam"):
        pass
    assert re.fullmatch(r"fit; 0:\d\d\n", told + capsys.readouterr().err)


CODE = """
import time
from stitch.cli.progress import TimeLeft, show_activity
from stitch.system.process import steps, watched
with watched(TimeLeft()), show_activity("diagnosing [2]"):
    time.sleep(1.2)
    for _ in steps("scans", range(4)): time.sleep(0.4)
    time.sleep(1.2)
"""


def test_a_terminal_shows_it_and_a_pipe_gets_a_line_a_step():
    """Four programs at once, since most of their time is sleep."""
    ours, theirs = pty.openpty()
    quiet = {key: value for key, value in os.environ.items() if key != "STITCH_PROGRESS"}
    command = [sys.executable, "-c", CODE]
    terminal = subprocess.Popen(command, stderr=theirs, env={**quiet, "TERM": "xterm", "COLUMNS": "100"})
    pipe, *silent = (
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=quiet | asked)
        for asked in ({}, {"STITCH_PROGRESS": "json"}, {"STITCH_PROGRESS": "off"})
    )
    assert terminal.wait() == 0
    os.close(theirs)
    shown = os.read(ours, 100_000)
    os.close(ours)
    # Before a loop and after it the line says what is done, and the time goes on.
    before, after = re.split(rb"scans: 3 of 4, \d:\d\d left", shown, maxsplit=1)
    seconds = [re.findall(rb"diagnosing \[2\]; 0:(\d\d)", part) for part in (before, after)]
    assert int(seconds[0][0]) < int(seconds[1][-1])
    assert re.fullmatch(r"diagnosing \[2\]; 0:\d\d\nscans: 3 of 4, 0:\d\d left\n", pipe.communicate()[1])
    assert [program.communicate()[1] for program in silent] == ["", ""]
    assert [program.returncode for program in (pipe, *silent)] == [0, 0, 0]


HUMIDITY = [40.0, 43.0, 46.0]


@pytest.fixture(scope="module")
def run_folder(_blade_on_disk, tmp_path_factory, stitch_command):
    """A run of three views, of which views.csv knows the humidity."""
    folder = tmp_path_factory.mktemp("notes")
    views = shutil.copytree(_blade_on_disk, folder / "s") / "views.csv"
    header, *rows = views.read_text().splitlines()
    rows = [f"{row},{h}" for row, h in zip(rows, HUMIDITY, strict=True)]
    views.write_text("\n".join([f"{header},humidity_percent", *rows]) + "\n")
    stitch_command("run", folder / "s", "-o", folder / "r", "--no-recording")
    return folder / "r"


def test_a_note_stays_in_the_ledger_when_the_model_changes(run_folder, stitch_command, monkeypatch):
    stitch_command("note", run_folder, "clamp was loose", "--by", "Q")
    stitch_command("note", run_folder, "  measured again ", "--step", "0")
    monkeypatch.setenv("STITCH_PROGRESS", "json")
    said = ended("add", run_folder, "range_scale", "--no-recording").err
    lines = [json.loads(line) for line in said.splitlines() if line.startswith('{"progress"')]
    steps = json.loads((run_folder / "ledger.json").read_text())
    told = [(note["by"], note["text"]) for note in steps[0]["notes"]]
    assert told == [("Q", "clamp was loose"), ("", "measured again")]
    assert [step["effects"] for step in steps] == [[], ["range_scale"]]
    assert "notes" not in steps[1]
    fit = [line["iteration"] for line in lines if line["progress"] == "fit"]
    assert fit == list(range(1, len(fit) + 1)) != []
    assert lines[-1]["progress"] == "writing"
    assert lines[-1]["residual_um"] == pytest.approx(1e3 * steps[1]["residual_rms"])


@pytest.mark.parametrize("words", [["  "], ["x" * 2001], ["fine", "--step", "9"]], ids=["empty", "long", "no step"])
def test_a_note_that_cannot_be_kept_changes_nothing(run_folder, words):
    before = (run_folder / "ledger.json").read_bytes()
    told = ended("note", run_folder, *words, code=InputError.exit_code)
    assert told.err.startswith("stitch: ")
    assert (run_folder / "ledger.json").read_bytes() == before


def test_compare_tells_where_every_view_stood(run_folder, stitch_command):
    told = json.loads(stitch_command("compare", run_folder, "--json"))
    names = [line.split(",")[0] for line in (run_folder.parent / "s" / "views.csv").read_text().splitlines()[1:]]
    assert [view["view"] for view in told["views"]] == names
    np.testing.assert_allclose([view["values"]["humidity_percent"] for view in told["views"]], HUMIDITY)
