"""What a command prints on terminals of any width: no word and no number is broken."""

import io
import json
import re
from contextlib import redirect_stderr
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.cells import cell_len

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.cli.main import main
from stitch.system.lines import broken_lines

WIDTHS = (60, 80, 100, 140)
# A quantity as people read it: a number with its unit, a value with its uncertainty, a probability.
QUANTITY = re.compile(
    r"[-+]?\d[\d.,]*(?:e-?\d+)? (?:mm|µm|m|mrad|rad|%|°)(?!\w)|[\d.]+ ± [\d.–]+|\b[pk] [=<≤] [\d.e-]+"
)


@pytest.fixture(scope="module")
def printed(tmp_path_factory, stitch_command):
    """Lines that commands print of a session of labelled points, and where they are wrongly asked."""
    folder = tmp_path_factory.mktemp("lines")
    session, *_ = labelled_cell(2, views=24, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]))
    measured, run = write_labelled(folder / "s", session, "points"), folder / "r"
    out = io.StringIO()
    with redirect_stderr(out), pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", _without_pictures)
        stitch_command("check", measured)
        stitch_command("run", measured, "-o", run, "--no-recording")
        for command in ("compare", "diagnose"):
            stitch_command(command, run)
        stitch_command("add", run, "joint_offset", "--no-recording")
        for wrong in (["run", str(measured), "--effects", "elbow"], ["drop", str(run), "backlash"]):
            with pytest.raises(SystemExit):
                main(wrong)
    return out.getvalue().splitlines()


def _without_pictures(_, file, **options):
    if isinstance(file, Path):
        file.touch()
    else:
        file.write("" if options["format"] == "svg" else b"")


@pytest.mark.parametrize("width", WIDTHS)
def test_no_message_is_broken_inside_a_word_or_a_number(printed, width):
    assert sum(len(line) > width for line in printed) > 5
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
