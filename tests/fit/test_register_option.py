"""`--register`: the method that was asked for is the one that runs, is written down, and stays with the run."""

import json

import numpy as np
import pytest

import stitch
from stitch.api.pipeline import change, run
from stitch.cli.main import main
from stitch.errors import InputError
from stitch.fusion.register import DEFAULT, METHODS
from stitch.output.run_folder import write_with_page
from stitch.output.stored_run import load_run
from stitch.session.reading.session_folder import load_session
from viz.recording import run_markdown


def test_the_method_is_written_read_again_and_kept_by_a_change(session, tmp_path):
    loaded = load_session(session)
    usual, asked = run(loaded), run(loaded, register="gicp")
    assert usual.register_method == DEFAULT
    assert asked.register_method == "gicp"
    assert not np.array_equal(usual.poses, asked.poses)
    write_with_page(asked, tmp_path)
    stages = json.loads((tmp_path / "result.json").read_text())["stages"]
    assert [stage.get("method") for stage in stages] == [None, None, "gicp", None]
    state = load_run(tmp_path)
    assert state.register_method == "gicp"
    assert change(state, []).register_method == "gicp"
    assert usual.register_method == DEFAULT
    assert "Registered by plane to plane (GICP)" in run_markdown(asked, None)
    assert "Registered by DPWVM-style weighted fit" in run_markdown(usual, None)


def test_a_method_of_another_name_is_bad_input(session):
    with pytest.raises(InputError, match="--register icp: no method has this name; to fix: dpwvm or gicp"):
        run(load_session(session), register="icp")
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "--register", "icp"])
    assert ended.value.code == 2


def test_from_python_the_method_is_that_of_the_command(session):
    loaded = stitch.load_session(session)
    found = stitch.run(loaded, register="gicp")
    assert found.register_method == "gicp"
    assert np.array_equal(found.poses, run(loaded, register="gicp").poses)
    assert stitch.run_rig([loaded], register="gicp")[0].register_method == "gicp"


def test_both_methods_stand_by_their_names():
    assert list(METHODS) == ["dpwvm", "gicp"]
    assert all(name == method.name for name, method in METHODS.items())
