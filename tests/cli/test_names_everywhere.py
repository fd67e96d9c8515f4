"""Names of views that are formulas, markup, emoji or written from right to left, in all places where names are drawn."""

import csv
import html
import json
import subprocess
import sys
import warnings

import pytest
from matplotlib.figure import Figure
from rerun import escape_entity_path_part
from rerun.chunk import RrdReader

from viz.figures import png

NAMES = ["$\\bad$ {0} %d", "[red]x[/red] :smile: <i>a</i> \U0001f642", "\u05e9\u05dc\u05d5\u05dd $x_{ \\frac"]
# One start of Python for all three commands.
CODE = """
from stitch.cli.main import main

for line in (["run", "s", "-o", "r"], ["compare", "r"], ["report", "r", "--no-diagnosis"]):
    try:
        main(line)
    except SystemExit as ended:
        if ended.code:
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
    return folder / "r", ended.stderr


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
