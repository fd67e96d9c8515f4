"""The commands and the Python of every page, and the notebooks, run as they stand: they print what they show."""

import re
from contextlib import chdir

import pytest
from matplotlib.figure import Figure

import stitch
from bench.docs.page_blocks import PAGES, blocks, examples
from bench.docs.page_examples import PROGRAM, differences, moved_line, printed, tool_errors
from bench.docs.site_pages import NOTEBOOK, NOTEBOOKS, cells, notebook_page, printed_in, run_cells
from stitch.effects import EFFECTS
from tests.needs import needs_open3d

# A second or two each; the others simulate, run and diagnose.
CHEAP = {"base-to-base", "drilling", "effects", "session"}
# The recipes have a test of their own, with stand-ins for the devices.
OTHERS = [page for page in PAGES if page.stem != "recipes"]
RUN = [page for page in OTHERS if any(b.language in ("console", "python") and not b.not_run for b in blocks(page))]


@pytest.fixture
def same_library():
    """Effects of one's own are gone afterwards."""
    before = dict(EFFECTS)
    yield
    EFFECTS.clear()
    EFFECTS.update(before)


@pytest.mark.usefixtures("no_drawing", "same_library")
@pytest.mark.parametrize(
    "page", [pytest.param(p, id=p.name, marks=() if p.stem in CHEAP else pytest.mark.slow) for p in RUN]
)
def test_a_page_prints_what_it_shows(page, tmp_path):
    for anew, shown in zip(printed(page, tmp_path), examples(page), strict=True):
        assert not differences(anew, shown), f"to fix: python -m bench.docs.page_examples docs/{page.name}"
    own = {}
    with chdir(tmp_path):
        for block in blocks(page):
            if block.language == "python" and not block.not_run:
                exec(compile(block.text, page.name, "exec"), own)
    if page.stem == "back-into-the-cell":
        the_copy_is_right(tmp_path, page.read_text(encoding="utf-8"))


def the_copy_is_right(folder, page):
    """Only numbers differ from the program, as the page shows; the true arm shares no code with the model."""
    number = re.compile(r"-?\d[\d,.e-]*")
    copy = (folder / "scan-compensated.src").read_text()
    assert copy != PROGRAM and number.sub("#", copy) == number.sub("#", PROGRAM)
    assert not differences(moved_line(folder), re.search(r"(?m)^LIN .*; along$", page)[0])
    before, after = (tool_errors(folder, name) for name in ("scan.src", "scan-compensated.src"))
    assert after.max() < 0.1 * before.min()


def test_another_number_and_another_word_are_seen():
    shown = "held-out 40.4 µm, p = 8e-18, 1,200 points"
    assert not differences("held-out 40.5 µm, p = 7e-18, 1,199 points", shown)
    assert differences("held-out 40.6 µm, p = 8e-18, 1,200 points", shown)
    assert differences("held out 40.4 µm, p = 8e-18, 1,200 points", shown)
    assert differences(shown + " more", shown)


def code_of(file):
    """The cells of code."""
    return [cell for cell in cells(file) if cell["cell_type"] == "code"]


@pytest.mark.slow
@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_the_notebook_prints_what_it_shows(file):
    if file != NOTEBOOK:
        needs_open3d()
    done = run_cells(file)
    for (text, _), cell in zip(done, code_of(file), strict=True):
        assert not differences(text, printed_in(cell)), "to fix: python -m bench.docs.site_pages notebooks"
    values = [value for _, value in done if value is not None]
    if file == NOTEBOOK:
        assert any(isinstance(value, Figure) for value in values)
    else:
        (shown,) = (value for value in values if isinstance(value, stitch.Run))
        assert shown._repr_html_().startswith("<iframe") and "showPart" in shown._repr_html_()


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_the_page_of_a_notebook_has_every_cell_and_picture(file):
    page, code = notebook_page(file), code_of(file)
    assert page.count("```python\n") == len(code)
    assert page.count("](data:image/png;base64,") == (1 if file == NOTEBOOK else 0)
    assert all("".join(cell["source"]) in page for cell in cells(file))
