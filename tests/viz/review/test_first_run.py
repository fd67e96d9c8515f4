"""A folder of scans becomes a session, a run and a diagnosis by what its page asks of the server."""

import shutil

import pytest

from tests.viz.review.conftest import served, until


@pytest.fixture
def scans(_blade_on_disk, tmp_path):
    """The clouds of a session with their table, as somebody else's program would have left them."""
    folder = tmp_path / "scans"
    shutil.copytree(_blade_on_disk / "clouds", folder / "clouds")
    shutil.copy(_blade_on_disk / "views.csv", folder / "poses.csv")
    return folder


def test_scans_are_run_and_diagnosed_and_then_reviewed(scans, tmp_path):
    run = tmp_path / "run"
    with served(scans, "-o", run) as server:
        assert "first_run.js" in server.get("")[1] and not run.exists()
        status, told = server.post("first", {"options": {}})
        assert status == 200 and told["views"] == 3
        usual = {guess["what"] for guess in told["guesses"] if guess["because"] == "usual"}
        assert "length_unit" in usual
        # Another answer replaces what this page wrote.
        status, told = server.post("first", {"options": {"unit": "mm", "cloud_unit": "mm"}})
        stated = {guess["what"]: guess["because"] for guess in told["guesses"]}
        assert status == 200 and stated["length_unit"] == stated["cloud_unit"] == "file"
        heard = server.listen()
        assert server.post("measure", {})[0] == 200
        assert server.post("measure", {})[0] == 409
        for kind in ("run", "diagnose"):
            done = until(
                heard,
                lambda e, kind=kind: (
                    e["type"] == "job" and e["job"]["kind"] == kind and e["job"]["state"] in ("done", "failed")
                ),
            )
            assert done["job"]["state"] == "done", done["job"]["lines"]
        assert "review.js" in server.get("")[1] and server.state()["problem"] is None
    assert (run / "diagnosis.json").is_file()


def test_what_is_refused_comes_with_what_leads_on_and_nothing_is_written(scans, tmp_path):
    (scans / "poses.csv").unlink()
    with served(scans, "-o", tmp_path / "run") as server:
        status, told = server.post("first", {"options": {}})
        said = told.get("refused") or told.get("problem")
        assert status in (200, 422) and "pose" in said
        assert server.post("first", {"options": {"unit": 3}})[0] == 400
    assert not (scans / "session.toml").exists()


def test_a_run_that_is_there_already_is_named(small_run, scans):
    with served(scans, "-o", small_run) as server:
        assert "a run is there; to fix: `stitch review" in server.address
