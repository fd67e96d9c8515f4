"""The commands of docs/back-into-the-cell.md, on the run that the page speaks of."""

import re

import pytest

from bench.back_into_the_cell_output import PAGE, PROGRAM, prepare, tool_errors
from bench.readme_output import commands, printed, shown

# A simulation and a run.
pytestmark = pytest.mark.slow
NUMBER = re.compile(r"-?\d[\d,.e-]*")


def test_the_commands_of_the_page_print_what_it_shows(tmp_path):
    page = shown(PAGE)
    prepare(tmp_path)
    anew = printed(commands(page), tmp_path)
    assert NUMBER.sub("#", " ".join(anew.split())) == NUMBER.sub("#", " ".join(page.split()))
    copy = (tmp_path / "scan-compensated.src").read_text()
    assert copy != PROGRAM and NUMBER.sub("#", copy) == NUMBER.sub("#", PROGRAM)
    # What the page shows of the copy stands in it.
    block = PAGE.read_text(encoding="utf-8").split("have changed:\n\n```\n")[1].split("```")[0]
    assert NUMBER.sub("#", block).strip() in NUMBER.sub("#", copy)
    # The true arm shares no code with the model.
    before, after = (tool_errors(tmp_path, name) for name in ("scan.src", "scan-compensated.src"))
    assert after.max() < 0.1 * before.min()
