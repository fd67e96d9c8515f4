"""Fixtures: the measured data beside the project, small synthetic cells, the command line."""

import gc
import os
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import settings
from matplotlib.figure import Figure

from data_synth.fixtures.blade_cells import captured_blade, measured_blade
from data_synth.write import write_session
from stitch.cli.report import printing_browser
from stitch.diagnosis import candidates
from stitch.effects import EFFECTS
from stitch.errors import InputError
from stitch.system.process import keep_freed_memory
from stitch.system.threads import library_threads_off
from tests.command_line import ended
from tests.in_browser import DRAWN

# Two test processes that each use all cores would fight for them.
if os.environ.get("PYTEST_XDIST_WORKER") and hasattr(os, "sched_setaffinity"):
    _cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {_cores[int(os.environ["PYTEST_XDIST_WORKER"][2:]) % len(_cores)]})

# What a command prints does not hang on how long the machine takes.
os.environ.setdefault("STITCH_PROGRESS", "off")

# As the command line does.
keep_freed_memory()

# As inside a run: the tests call the stages directly.
library_threads_off()

# A busy machine is no failure.
settings.register_profile("any_machine", deadline=None)
settings.load_profile("any_machine")

# Of what collection makes nothing can go: looking through it again and again costs a tenth of it.
gc.disable()

# The longest files, which begin first: with files spread over two processes none is left alone at the end.
LONGEST = [
    "test_stitch",
    "test_api",
    "test_pipeline",
    "test_view_screening",
    "test_diagnosis",
    "test_robot",
    "test_run",
    "test_live",
    "test_conventions",
    "test_stock",
    "test_first_session",
    "test_run_page",
    "test_drive",
    "test_deciding_view",
    "test_first_run",
    "test_session",
    "test_window",
    "test_coarse",
    "test_scanner_places",
    "test_carried_scans",
]


def pytest_collection_finish():
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items):
    place = {name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not SHARED.is_dir():
        pytest.skip(f"measured data are not at {SHARED}")
    return SHARED


@pytest.fixture(scope="session")
def reghec(shared_data):
    """Path of a session of the RegHEC scans by its name."""
    return lambda name: shared_data / "reghec" / name


@pytest.fixture(scope="session")
def stitch_command():
    """The command line, which ends with exit code 0: its arguments to what it prints on stdout."""
    return lambda *words: ended(*words).out


@pytest.fixture(scope="session")
def browser():
    """A Chromium that is on the path, driven by playwright."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    try:
        path = printing_browser()
    except InputError:
        pytest.skip("no Chromium is on the path")
    root = ["--no-sandbox"] if os.geteuid() == 0 else []
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=path, args=[*root, *DRAWN])
        yield opened
        opened.close()


@pytest.fixture
def no_drawing(monkeypatch):
    """Pictures are written empty: most of the time of a page, for tests that look at its words alone."""
    monkeypatch.setattr(Figure, "savefig", _empty)


def _empty(_, file, **options):
    if isinstance(file, Path):
        file.touch()
    else:
        file.write("" if options["format"] == "svg" else b"")


@pytest.fixture(scope="session")
def blade_capture():
    """What a cell with a blade measured in five views, and its scans made ready."""
    return captured_blade(0, views=5)


@pytest.fixture(scope="session")
def still_cells():
    """Per mount what a cell with nothing wrong and perfect poses measured."""
    common = {"views": 4, "repeatability": (0.0, 0.0), "pixels": 40}
    return {mount: measured_blade(0, mount=mount, **common) for mount in ("eye_to_hand", "eye_in_hand")}


@pytest.fixture(scope="session")
def _blade_on_disk(tmp_path_factory):
    folder = tmp_path_factory.mktemp("blade") / "s"
    measured = measured_blade(0, views=3, pixels=50)
    # A rail leaves joints and robot out: each test adds what it is about.
    write_session(folder, replace(measured, scene=replace(measured.scene, rail=1.0), covariates={}), "s")
    file = folder / "views.csv"
    rows = [line.split(",") for line in file.read_text().splitlines()]
    file.write_text("\n".join(",".join(row[:2] + row[3:-1]) for row in rows) + "\n")
    return folder


@pytest.fixture
def session(_blade_on_disk, tmp_path):
    """A small blade session on disk, of one's own: clouds and poses alone."""
    return Path(shutil.copytree(_blade_on_disk, tmp_path / "s"))


FEW = ("joint_offset", "joint_compliance", "gear_eccentricity", "gear_harmonic", "backlash")


@pytest.fixture(scope="session")
def library_of():
    """A context in which the library holds some effects alone, a few of joints unless they are named."""

    @contextmanager
    def only(names=FEW):
        whole = dict(EFFECTS)
        for name in whole.keys() - set(names):
            del EFFECTS[name]
        yield
        # In their order: what is drawn at random goes by it.
        EFFECTS.clear()
        EFFECTS.update(whole)

    return only


@pytest.fixture
def few_effects(monkeypatch, library_of):
    """A small library: what is tested is the choice, not how long all of it takes."""
    monkeypatch.setattr(candidates, "empirical_effects", lambda views: [])
    with library_of():
        yield
