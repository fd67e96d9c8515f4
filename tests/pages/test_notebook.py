"""The notebook, run as plain Python: it prints what it shows, and ends with a picture."""

import pytest
from matplotlib.figure import Figure

from bench.docs.notebook_page import NOTEBOOK, cells, notebook_page, printed_in, run_cells
from bench.docs.page_examples import differences

CODE = [cell for cell in cells(NOTEBOOK) if cell["cell_type"] == "code"]


@pytest.mark.slow
def test_the_notebook_prints_what_it_shows():
    done = run_cells(NOTEBOOK)
    for (text, _), cell in zip(done, CODE, strict=True):
        assert not differences(text, printed_in(cell)), "to fix: python -m bench.docs.notebook_page"
    assert any(isinstance(value, Figure) for _, value in done)


def test_its_page_has_every_cell_and_the_picture():
    page = notebook_page(NOTEBOOK)
    assert page.count("```python\n") == len(CODE) and page.count("](data:image/png;base64,") == 1
    assert all("".join(cell["source"]) in page for cell in cells(NOTEBOOK))
