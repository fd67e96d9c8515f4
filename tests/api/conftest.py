"""A small cell for the library: five views of a blade, its scans and poses as arrays, its session, and a run of it."""

import numpy as np
import pytest

import stitch
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.write import write_session


@pytest.fixture(scope="session")
def cell():
    """What the cell measured."""
    return measured_blade(0, views=5, mount="eye_in_hand", pixels=40)


@pytest.fixture(scope="session")
def arrays(cell):
    """Its scans, and poses (V, 4, 4)."""
    return [cloud.points for cloud in cell.clouds], np.array(cell.T_base_flange)


@pytest.fixture(scope="session")
def cell_folder(cell, tmp_path_factory):
    """Its session on disk."""
    folder = tmp_path_factory.mktemp("api") / "s"
    write_session(folder, cell, "s")
    return folder


@pytest.fixture(scope="session")
def loaded(cell_folder):
    """That session, read."""
    return stitch.load_session(cell_folder)


@pytest.fixture(scope="session")
def found(loaded):
    """A run of it."""
    return stitch.run(loaded)


@pytest.fixture(scope="session")
def better(found):
    """The run with one effect more."""
    return stitch.add(found, "range_scale")
