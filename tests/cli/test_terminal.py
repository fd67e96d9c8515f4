"""What a command prints: results alone on standard output, whole words on terminals of any width, names of views as they are."""

import csv
import html
import json
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rerun import escape_entity_path_part
from rerun.chunk import RrdReader
from rich.cells import cell_len

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.cli.main import main
from stitch.cli.terminal import emit, stdout_for_results
from stitch.system.lines import broken_lines
from tests.command_line import ended
from viz.figures import png

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


def test_what_a_command_prints_on_the_way_goes_to_standard_error(capsys):
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


def test_what_a_command_finds_goes_to_standard_output_as_a_process_too(tmp_path):
    """There descriptor 1 leads to 2 while a command runs, so that no library's line comes between."""
    session, *_ = labelled_cell(2, views=12, offset=np.zeros(6))
    measured, run = write_labelled(tmp_path / "s", session, "points"), tmp_path / "r"
    ended = subprocess.run([*MAIN, "run", measured, "-o", run, "--no-recording"], capture_output=True, text=True)
    assert "Hand-eye T_base_scanner" in ended.stdout and f"Next: stitch diagnose {run}" in ended.stdout, ended.stderr
    assert "Hand-eye" not in ended.stderr and "Next:" not in ended.stderr
    ended = subprocess.run([*MAIN, "add", run, "elbow"], capture_output=True, text=True)
    assert ended.returncode == 2 and not ended.stdout and ended.stderr.startswith("stitch: no effect 'elbow'")


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_letters_that_a_terminal_does_not_have_are_spelt(encoding):
    environment = os.environ | {"PYTHONIOENCODING": encoding, "COLUMNS": "200"}
    ended = subprocess.run([*MAIN, "effects"], env=environment, capture_output=True)
    assert not ended.returncode and b"range_scale" in ended.stdout


def test_a_reader_that_has_seen_enough_is_no_fault():
    with subprocess.Popen([*MAIN, "effects"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as command:
        command.stdout.close()
        assert command.stderr.read() == b""


WIDTHS = (60, 80, 100, 140)
# A quantity as people read it: a number with its unit, a value with its uncertainty, a probability.
QUANTITY = re.compile(
    r"[-+]?\d[\d.,]*(?:e-?\d+)? (?:mm|µm|m|mrad|rad|%|°)(?!\w)|[\d.]+ ± [\d.–]+|\b[pk] [=<≤] [\d.e-]+"
)


@pytest.fixture(scope="module")
def printed(tmp_path_factory, library_of):
    """Lines that commands print of a session of labelled points, and where they are wrongly asked."""
    folder = tmp_path_factory.mktemp("lines")
    session, *_ = labelled_cell(2, views=24, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]))
    measured, run = write_labelled(folder / "s", session, "points"), folder / "r"
    right = (
        ("check", measured),
        ("run", measured, "-o", run, "--no-recording"),
        ("compare", run),
        ("diagnose", run),
        ("add", run, "joint_offset", "--no-recording"),
    )
    wrong = (("run", measured, "--effects", "elbow"), ("drop", run, "backlash"))
    with pytest.MonkeyPatch.context() as patch, library_of():
        patch.setattr(Figure, "savefig", _without_pictures)
        said = [ended(*words) for words in right] + [ended(*words, code=2) for words in wrong]
    return "".join(told.err + told.out for told in said).splitlines()


def _without_pictures(_, file, **options):
    if isinstance(file, Path):
        file.touch()
    else:
        file.write("" if options["format"] == "svg" else b"")


@pytest.mark.parametrize("width", WIDTHS)
def test_no_message_is_broken_inside_a_word_or_a_number(printed, width):
    assert sum(len(line) > width for line in printed) > 3
    for message in printed:
        lines = broken_lines(message, width)
        assert " ".join(lines).split() == message.split()
        assert [line for line in lines if cell_len(line) > width and len(line.split()) > 1] == []
        whole = [found for line in lines for found in QUANTITY.findall(line)]
        assert whole == QUANTITY.findall(message), lines


@pytest.mark.parametrize("width", WIDTHS)
def test_a_terminal_gets_whole_words_and_tables_that_fit(width, monkeypatch, capsys):
    """As a terminal of that width: rich takes its size and kind from the environment."""
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    with pytest.raises(SystemExit):
        main(["effects"])
    shown = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out)
    assert [line for line in shown.splitlines() if cell_len(line) > width] == []
    with pytest.raises(SystemExit):
        main(["effects", "--json"])
    formulas = [effect["formula"] for effect in json.loads(capsys.readouterr().out)]
    assert all(" ".join(formula.split()) in " ".join(shown.split()) for formula in formulas)


NAMES = ["$\\bad$ {0} %d", "[red]x[/red] :smile: <i>a</i> \U0001f642", "\u05e9\u05dc\u05d5\u05dd $x_{ \\frac"]
# One start of Python for all three commands.
CODE = """
from stitch.cli.main import main

for line in (["run", "s", "-o", "r"], ["compare", "r"], ["report", "r", "--no-diagnosis"]):
    try:
        main(line)
    except SystemExit as stop:
        if stop.code:
            raise
"""


@pytest.fixture(scope="module")
def drawn(_blade_on_disk, tmp_path_factory):
    """A run of three such views with pictures, page and recording, and what the commands said."""
    folder = tmp_path_factory.mktemp("names")
    session = folder / "s"
    session.mkdir()
    for file in _blade_on_disk.iterdir():
        (session / file.name).symlink_to(file)
    (session / "views.csv").unlink()
    rows = list(csv.reader((_blade_on_disk / "views.csv").read_text().splitlines()))
    with (session / "views.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([rows[0], *([name, *row[1:]] for name, row in zip(NAMES, rows[1:], strict=True))])
    ended = subprocess.run([sys.executable, "-c", CODE], cwd=folder, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return folder / "r", ended.stdout + ended.stderr


def test_a_terminal_shows_names_as_they_are_and_nothing_warns(drawn):
    _, said = drawn
    assert all(name in said for name in NAMES)
    assert "WARN" not in said and "Warning" not in said and "\x1b" not in said


def test_results_name_views_in_the_order_of_the_table(drawn):
    folder, _ = drawn
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    assert [view["view"] for view in result["views"]] == NAMES
    compared = json.loads((folder / "compare.json").read_text(encoding="utf-8"))
    assert [view["view"] for view in compared["views"]] == NAMES


def test_the_page_shows_names_as_text(drawn):
    page = (drawn[0] / "report.html").read_text(encoding="utf-8")
    assert "<i>a</i>" not in page and html.escape(NAMES[1]) in page
    assert all(html.escape(name) in page or json.dumps(name)[1:-1] in page for name in NAMES)


def test_the_recording_has_a_place_for_every_name(drawn):
    places = {chunk.entity_path for chunk in RrdReader(str(drawn[0] / "recording.rrd")).stream()}
    assert {f"/scans/{escape_entity_path_part(name)}" for name in NAMES} <= places


def test_a_figure_shows_names_as_they_are():
    figure = Figure()
    axes = figure.subplots()
    axes.set_xlabel(NAMES[0])
    axes.set_yticks([0, 1, 2], NAMES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(png(figure, 50)) > 1000
