"""What a stranger asks first: help with examples that parse, cheap ones that run, the version, the tab key, the effects."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
import typer

from data_synth.fixtures.run_folders import bare_run
from stitch.cli.main import build
from stitch.cli.options import complete_effect
from stitch.effects import EFFECTS
from stitch.system.packages import stitch_version
from tests.command_line import ended


def commands(group, words=()):
    """Every command with the words that call it."""
    for name in group.commands:
        command = group.commands[name]
        if hasattr(command, "commands"):
            yield from commands(command, (*words, name))
        else:
            yield (*words, name), command


COMMANDS = dict(commands(typer.main.get_command(build())))


def examples(command):
    """Lines of its help, after the word Examples."""
    return re.findall(r"^ *(stitch .*?) *$", command.help.partition("Examples:")[2], re.MULTILINE)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_help_has_examples_that_parse(words):
    command = COMMANDS[words]
    lines = examples(command)
    assert lines, f"stitch {' '.join(words)} --help shows no example; write some into its docstring, after Examples:"
    for line in lines:
        call = shlex.split(line)
        assert tuple(call[1 : 1 + len(words)]) == words
        # Unknown options, missing arguments and numbers that are none end in an error.
        command.make_context(line, call[1 + len(words) :])
        assert len(line) < 110


@pytest.mark.parametrize(
    "line",
    [
        *(line for name in ("effects", "check", "export") for line in examples(COMMANDS[(name,)])),
        "stitch --version",
        "stitch --help",
        "stitch export --help",
    ],
)
def test_the_cheap_examples_run(line, session, tmp_path, monkeypatch):
    """In a folder with the session and the run that they speak of."""
    if re.search("--program|--deep|mine.py|glb", line):
        pytest.skip("needs a run of an arm, minutes, or a file of one's own")
    shutil.move(session, tmp_path / "blade-17")
    (tmp_path / "runs").mkdir()
    bare_run(tmp_path / "runs" / "blade-17", np.eye(4), np.eye(6))
    monkeypatch.chdir(tmp_path)
    ended(*shlex.split(line)[1:])


def test_version_is_the_package_s():
    assert ended("--version").out == f"stitch {stitch_version()}\n"


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("stitch ex", ["explain", "export"]),
        pytest.param("stitch calibrate sp", ["sphere"], marks=pytest.mark.slow),
        pytest.param("stitch export r --to ar", ["arm-dh", "arm-urdf"], marks=pytest.mark.slow),
        pytest.param("stitch run --eff", ["--effects", "--effects-file"], marks=pytest.mark.slow),
    ],
)
def test_the_tab_key(typed, offered):
    """As a shell asks: no library is loaded for a name."""
    code = "import sys; sys.argv[0] = 'stitch'\nfrom stitch.cli.main import main\ntry: main()\nfinally: print('numpy' in sys.modules)"
    asked = {"_STITCH_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | asked, check=False
    )
    *names, loaded = out.stdout.split()
    assert names == offered
    assert loaded == "False"


def test_the_tab_key_knows_effects_and_goes_on_behind_a_comma():
    assert complete_effect("mount_b") == ["mount_bend"]
    assert complete_effect("backlash,joint_o") == ["backlash,joint_offset"]
    assert complete_effect("nothing") == []


def test_run_takes_the_session_one_stands_in(session, monkeypatch):
    monkeypatch.chdir(session)
    told = ended("run", "--no-recording").out
    assert (session.parent / "runs" / session.name / "result.json").is_file()
    assert sorted(path.name for path in session.iterdir()) == ["clouds", "session.toml", "views.csv"]
    # What a person needs at the end: the hand-eye with U and its frame, errors, files, what to do next.
    assert re.search(
        r"Hand-eye T_base_scanner, in the frame of the base, ± U \(k = 2\) for a complete model:\n"
        r"  position x -?[\d.]+ ± [\d.]+,",
        told,
    )
    assert re.search(r"rotation vector x .* mrad\n", told)
    for name in ("error on views left out", "error in the fit", "sensor's noise alone"):
        assert re.search(rf"\n  {name} +[\d.]+ µm\n", told)
    assert told.rstrip().endswith(f"Next: stitch diagnose ../runs/{session.name}")
    assert "\x1b" not in told and "\r" not in told  # quiet where nobody watches


def test_run_without_a_session_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = ended("run", code=2)
    assert "this folder has no session.toml; to fix: name a session" in told.err


def test_the_folder_of_raw_scans_is_no_session_and_becomes_one_by_init(tmp_path):
    (tmp_path / "my scans").mkdir()
    printed = ended("run", tmp_path / "my scans", code=2)
    assert "session.toml: not found; a session is a folder" in (told := printed.err)
    assert f"`stitch init '{tmp_path}/my scans'`" in told


def test_the_library_of_effects_is_printed_as_json():
    printed = ended("effects", "part_slip", "--json")
    (told,) = json.loads(printed.out)
    assert told["effect"] == "part_slip" and [p["unit"] for p in told["parameters"]] == ["rad", "view"]


USER = """
from stitch.effects import effect, number

@effect("sensor", k=number("mm", typical=0.02, limit=1.0))
def of_my_own(points, view, k):
    return points
"""


@pytest.mark.parametrize(("name", "expected"), [("mine.txt", "mine.py"), ("mine.py", "'of_my_own' has no docstring")])
def test_effects_that_cannot_be_loaded_are_refused(tmp_path, name, expected):
    (tmp_path / name).write_text(USER)
    printed = ended("effects", "--effects-file", tmp_path / name, code=2).err
    assert printed.startswith(f"stitch: {tmp_path / name}: ") and expected in printed and printed.count("\n") == 1
    assert "of_my_own" not in EFFECTS
