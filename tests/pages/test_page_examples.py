"""The commands and the Python of every page, and the notebooks, run as they stand: they print what they show.

The diffs of docs/extend.md, applied to a copy of the tree, do what the page says.
"""

import re
import shutil
import subprocess
import sys
from contextlib import chdir
from pathlib import Path

import pytest
from matplotlib.figure import Figure

import stitch
from bench.docs.page_examples import PAGES, PROGRAM, blocks, differences, examples, moved_line, printed, tool_errors
from bench.docs.site_pages import NOTEBOOK, NOTEBOOKS, cells, notebook_page, printed_in, run_cells
from stitch.effects import EFFECTS
from tests.needs import needs_open3d

# A second or two each; the others simulate, run and diagnose.
CHEAP = {"base-to-base", "drilling", "effects", "session"}
# The recipes have a test of their own, with stand-ins for the devices.
OTHERS = [page for page in PAGES if page.stem != "recipes"]
RUN = [page for page in OTHERS if any(b.language in ("console", "python") and not b.not_run for b in blocks(page))]
ROOT = Path(__file__).resolve().parents[2]


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
        framed = shown._repr_html_()
        assert framed.startswith("<iframe") and "part-data" in framed and "function partDrawing" in framed


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_the_page_of_a_notebook_has_every_cell_and_picture(file):
    page, code = notebook_page(file), code_of(file)
    assert page.count("```python\n") == len(code)
    assert page.count("](data:image/png;base64,") == (1 if file == NOTEBOOK else 0)
    assert all("".join(cell["source"]) in page for cell in cells(file))


def applied(page: Path, root: Path) -> None:
    """Apply every diff of a page to a copy of the tree: each hunk's lines stand in the file exactly once."""
    for diff in re.findall(r"```diff\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        target = root / re.search(r"^\+\+\+ b/(\S+)", diff, re.MULTILINE)[1]
        for hunk in diff.split("\n@@\n")[1:]:
            lines = hunk.splitlines()
            old = "".join(f"{line[1:]}\n" for line in lines if line[:1] != "+")
            new = "".join(f"{line[1:]}\n" for line in lines if line[:1] != "-")
            text = target.read_text(encoding="utf-8") if target.exists() else ""
            assert text.count(old) == 1 if old else not text, f"{target}: {old}"
            target.write_text(text.replace(old, new) if old else new, encoding="utf-8")


EXTENDED = """
import numpy as np
from dataclasses import replace
from data_synth.fixtures.labelled_arm import labelled_cell
import stitch
from stitch.numerics import frames
from stitch.diagnosis import candidates
from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.thresholds import IMPLAUSIBLE
from stitch.effects import EFFECTS
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.model.model import Model
from stitch.observations.plate import plate_model

assert EFFECTS["mount_thermal_drift"].formula == "M·exp(ξ (T−T₀)), T = scanner_temperature_c"
for name in set(EFFECTS) - {"mount_thermal_drift", "joint_offset", "gear_eccentricity"}:
    del EFFECTS[name]
candidates.empirical_effects = lambda views: []

# The effect: what is put into a cell is found.
true = np.array([1e-4, -2e-4, 1.5e-4, 0.03, -0.02, 0.04])
cell, _, _ = labelled_cell(3, views=25, noise=0.005)
warm = 3 * np.sin(np.arange(25) / 4)
def seen(view, degrees):
    moved = frames.transform(frames.inverse(frames.exp(true * degrees)), view.sighting.points)
    return replace(
        view, covariates={"scanner_temperature_c": 20 + degrees}, sighting=replace(view.sighting, points=moved))
drifting = replace(cell, views=tuple(seen(v, d) for v, d in zip(cell.views, warm)))
term = stitch.run(drifting, effects=["mount_thermal_drift"]).terms[0]
off = (term.values - true) / term.sigmas
assert np.isfinite(off).all() and np.abs(off).max() < 4, off

# The observation: an offset of joint 3 that flat points alone show.
plate = np.array([[60., 10, 30], [-40, 55, 30], [-20, -60, 30], [10, 5, 30], [-70, -10, 30], [50, -50, 30]])
cell, T_mount, _ = labelled_cell(1, views=30, offset=np.array([0, 0, 1.5e-3, 0, 0, 0]), targets=plate)
linear = plate_model(measurement_of(cell, prepare_capture(cell)), Model(T_mount))
selection = gather_evidence(linear, candidates_of(linear)[0], ScatterLimit(*IMPLAUSIBLE))
assert selection.verdict == "missing_effect", selection.verdict
(best,) = selection.named
found = {p.name: (v, s) for p, v, s in zip(best.score.form.free, best.score.values, best.score.sigmas)}
assert best.name == "joint_offset" and list(found) == ["d3"], found
assert abs(found["d3"][0] - 1.5e-3) < 3 * found["d3"][1] < 3e-4, found

# The statistic: silent where the scatter is normal, heard where it has long tails.
rng = np.random.default_rng(0)
def notes(drawn):
    cell, _, _ = labelled_cell(5, views=25, noise=1e-3, scatter=(1e-6, 1e-3))
    noisy = [replace(v.sighting, points=v.sighting.points + 0.02 * drawn((4, 3)), sigma=np.full(4, 0.02))
             for v in cell.views]
    views = tuple(replace(v, sighting=s) for v, s in zip(cell.views, noisy))
    return stitch.diagnose(stitch.run(replace(cell, views=views))).notes
tails = (rng.standard_normal, lambda shape: rng.standard_t(2, shape))
heard = [any("not normal" in note for note in notes(drawn)) for drawn in tails]
assert heard == [False, True], heard
"""


def test_the_diffs_of_the_page_that_extends_work(tmp_path):
    shutil.copytree(ROOT / "stitch", tmp_path / "stitch", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "data_synth", tmp_path / "data_synth", ignore=shutil.ignore_patterns("__pycache__"))
    applied(ROOT / "docs" / "extend.md", tmp_path)
    command = [sys.executable, "-c", EXTENDED]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
