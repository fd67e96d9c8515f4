"""Joint angles become poses by a URDF that lies beside them; judged by what the simulated arm reported."""

import csv

import numpy as np
import pytest

from data_synth.write import write_session
from stitch.errors import InputError
from stitch.output.urdf_file import to_urdf
from stitch.plugins.intake.first_session import StatedFolder, first_session
from stitch.plugins.intake.raw_poses import read_raw_poses
from stitch.plugins.intake.readings import StatedTable, all_readings
from stitch.plugins.intake.session_draft import write_draft
from stitch.session.reading.session_folder import load_session

JOINTS = [f"j{i}_deg" for i in range(1, 7)]


@pytest.fixture(scope="module")
def cell(still_cells, tmp_path_factory):
    """A session with joints and robot, and a folder with its clouds, a table of its joints in radians and its URDF."""
    folder = tmp_path_factory.mktemp("joints")
    write_session(folder / "cell", still_cells["eye_in_hand"], "cell")
    session = load_session(folder / "cell")
    raw = folder / "raw"
    (folder / "cell" / "clouds").rename(folder / "clouds")
    raw.mkdir()
    (folder / "clouds").rename(raw / "clouds")
    (raw / "arm.urdf").write_text(to_urdf(session.robot), encoding="utf-8")
    with (raw / "joint_states.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", *(f"joint_{i}" for i in range(1, 7))])
        writer.writerows([10.0 + i, *view.joints] for i, view in enumerate(session.views))
    return session, raw


def test_joint_angles_give_the_poses_that_the_arm_reported(cell):
    session, raw = cell
    table = read_raw_poses([raw / "joint_states.csv"])
    (reading,) = all_readings(table, raw / "arm.urdf", StatedTable(angle_unit="rad"))
    assert np.abs(reading.T - [v.T_base_flange for v in session.views]).max() < 1e-3
    with pytest.raises(InputError, match="URDF"):
        all_readings(table, None, StatedTable())


def test_the_scans_tell_the_unit_of_joint_angles_and_the_mount(cell, tmp_path):
    session, raw = cell
    first = first_session(raw, StatedFolder())
    write_draft(tmp_path / "made", first)
    made = load_session(tmp_path / "made")
    assert made.mount == "eye_in_hand" and first.choice.determined
    for a, b in zip(made.views, session.views, strict=True):
        assert np.allclose(a.joints, b.joints, atol=1e-8) and np.abs(a.T_base_flange - b.T_base_flange).max() < 1e-3
    assert [view.time_s for view in made.views] == [0, 1, 2, 3]
