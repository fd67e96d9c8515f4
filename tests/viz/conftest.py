"""A small run with its recording."""

import pytest
import rerun as rr

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.write import write_session
from stitch.api.pipeline import run
from stitch.session.reading.session_folder import load_session
from viz.recording import RerunRecorder


@pytest.fixture(scope="package")
def recorded(tmp_path_factory):
    """A run of five views with its recording, in Rerun's strict mode."""
    folder = tmp_path_factory.mktemp("viz")
    write_session(folder / "s", measured_blade(0, views=5, pixels=70), "blade <1>")
    rr.set_strict_mode(True)
    try:
        result = run(load_session(folder / "s"), recorder=RerunRecorder(folder / "r.rrd"))
    finally:
        rr.set_strict_mode(False)
    return result, folder / "r.rrd"
