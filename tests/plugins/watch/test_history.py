"""The whole way: sessions on disk, run by the command line, one after the other into the history of their cell."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.cli.main import main

MOVED = np.array([0.15, 0.0, -0.08])  # mm, frame of the sensor: how the mount jumped
TURNED = Rotation.from_rotvec([0.0, 2e-4, 0.0]).as_matrix()


def session_of_day(folder, k, moved):
    """The same cell at the same poses; noise of its own, and a sensor that has moved."""
    session, T_mount, _ = labelled_cell(0, views=16, scatter=(0.0, 0.0), noise=0.0)
    rng = np.random.default_rng(100 + k)
    views = []
    for view in session.views:
        points = view.sighting.points
        if moved:
            points = (points - MOVED) @ TURNED
        points = points + 0.02 * rng.normal(size=points.shape)
        views.append(replace(view, sighting=replace(view.sighting, points=points)))
    return write_labelled(folder, replace(session, views=tuple(views))), T_mount


@pytest.mark.slow
def test_a_mount_that_jumped_is_found_from_run_folders(tmp_path, capsys):
    days, cell = 9, tmp_path / "cell"
    for k in range(days):
        session, _ = session_of_day(tmp_path / f"d{k}", k, moved=k >= 6)
        with pytest.raises(SystemExit) as ended:
            main(["run", str(session), "-o", str(tmp_path / f"r{k}"), "--no-recording"])
        assert not ended.value.code
        with pytest.raises(SystemExit) as ended:
            main(["watch", str(cell), "--add", str(tmp_path / f"r{k}"), "--at", f"2026-03-{k + 1:02d}T08:00", "--json"])
        told = json.loads(capsys.readouterr().out)
        assert (ended.value.code or 0) == (3 if k >= 7 else 0)
    moved = {p["name"]: p["alarm"] for p in told["parameters"] if p["alarm"]}
    assert all(alarm["since"] == "d6" and alarm["kind"] == "step" for alarm in moved.values())
    assert all(name.startswith("hand_eye.") for name in moved)
    # What the mount did, from the runs themselves: the last hand-eye against the mean of the first six.
    hand_eyes = [
        np.array(json.loads((tmp_path / f"r{k}" / "result.json").read_text())["hand_eye"]) for k in range(days)
    ]
    turned = Rotation.from_matrix(hand_eyes[-1][:3, :3] @ hand_eyes[0][:3, :3].T).magnitude()
    assert turned == pytest.approx(2e-4, abs=4e-5)
