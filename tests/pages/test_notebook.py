"""The notebooks, run as plain Python: they print what they show, one ends with a picture, one shows a viewer."""

import pytest
from matplotlib.figure import Figure

import stitch
from bench.docs.notebook_page import NOTEBOOK, NOTEBOOKS, cells, notebook_page, printed_in, run_cells
from bench.docs.page_examples import differences
from tests.needs import needs_open3d


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
        assert not differences(text, printed_in(cell)), "to fix: python -m bench.docs.notebook_page"
    values = [value for _, value in done if value is not None]
    if file == NOTEBOOK:
        assert any(isinstance(value, Figure) for value in values)
    else:
        (shown,) = (value for value in values if isinstance(value, stitch.Run))
        assert shown._repr_html_().startswith("<iframe") and "showPart" in shown._repr_html_()


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_its_page_has_every_cell_and_every_picture(file):
    page, code = notebook_page(file), code_of(file)
    assert page.count("```python\n") == len(code)
    assert page.count("](data:image/png;base64,") == (1 if file == NOTEBOOK else 0)
    assert all("".join(cell["source"]) in page for cell in cells(file))
