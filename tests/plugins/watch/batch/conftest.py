"""Small sessions of labelled points, who runs them, and the command."""

from dataclasses import replace

import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import run
from stitch.cli.main import main
from stitch.plugins.watch.batch import run_batch


@pytest.fixture(scope="module")
def cell():
    return labelled_cell(2, views=8)[0]


@pytest.fixture
def sessions(cell, tmp_path, monkeypatch):
    """Two small sessions of labelled points, in the folder one stands in."""
    monkeypatch.chdir(tmp_path)
    return [write_labelled(tmp_path / name, cell, "points") for name in ("monday", "tuesday")]


@pytest.fixture(scope="module")
def result(cell):
    """What a run of such a session finds; computed once."""
    return run(cell)


@pytest.fixture
def ran(monkeypatch, result):
    """Names of the sessions that were run, in their order; all have the same numbers."""
    names = []

    def noted(loaded, recorder):
        names.append(loaded.path.name)
        return replace(result, session=loaded)

    monkeypatch.setattr(run_batch, "run", noted)
    return names


@pytest.fixture
def batch():
    """stitch batch with some arguments, which ends with an exit code."""

    def call(*arguments, code=0):
        with pytest.raises(SystemExit) as stop:
            main(["batch", *map(str, arguments), "--no-recording"])
        assert (stop.value.code or 0) == code

    return call
