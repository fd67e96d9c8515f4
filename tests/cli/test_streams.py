"""Standard output carries results alone, on every terminal."""

import json
import os
import subprocess
import sys

import pytest

from stitch.cli.terminal import emit, stdout_for_results

PRINTS = """
import os, sys
print("from python"); sys.stdout.write("from a stream\\n"); os.write(1, b"from below\\n")
from stitch.effects import effect, number
@effect("sensor", k=number("mm", typical=0.02, limit=1.0))
def chatty(points, view, k):
    "x = x* + µ"
    return points
"""
MAIN = [sys.executable, "-c", "from stitch.cli.main import main; main()"]


def test_what_is_printed_on_the_way_goes_aside(capsys):
    @stdout_for_results
    def command():
        print("noise")
        emit("result")

    command()
    assert capsys.readouterr() == ("result\n", "noise\n")


def test_the_result_of_a_command_is_json_whatever_an_effect_prints(tmp_path):
    (tmp_path / "mine.py").write_text(PRINTS)
    ended = subprocess.run(
        [*MAIN, "effects", "chatty", "--effects-file", "mine.py", "--json"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert json.loads(ended.stdout)[0]["effect"] == "chatty"
    assert all(f"from {what}" in ended.stderr for what in ("python", "a stream", "below"))


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_letters_that_a_terminal_does_not_have_are_spelt(encoding):
    environment = os.environ | {"PYTHONIOENCODING": encoding, "COLUMNS": "200"}
    ended = subprocess.run([*MAIN, "effects"], env=environment, capture_output=True)
    assert not ended.returncode and b"range_scale" in ended.stdout


def test_a_reader_that_has_seen_enough_is_no_fault():
    with subprocess.Popen([*MAIN, "effects"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as command:
        command.stdout.close()
        assert command.stderr.read() == b""
