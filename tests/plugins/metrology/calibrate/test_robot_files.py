"""The table that `stitch calibrate robot` writes: what it says of itself, and that following it has the arm said."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import run
from stitch.plugins.metrology.calibrate.command import show_robot
from stitch.plugins.metrology.calibrate.robot import LinkTable, calibrated_robot_of_run, robot_document, write_robot
from stitch.session.reading.session_folder import load_session
from stitch.session.robot import forward
from stitch.session.session import StatedRepeatability

OFFSET = np.array([0, 1.2e-3, -1.5e-3, 0, 1e-3, 0])
POSE = "x,y,z,qx,qy,qz,qw"


def cell(folder, reported):
    """A session folder, with the poses of the nominal arm where they are reported, and a stated repeatability."""
    session, *_ = labelled_cell(5, views=16, offset=OFFSET)
    write_labelled(folder, session)
    if reported:
        header, *rows = (folder / "views.csv").read_text().split()
        poses = [
            [*v.T_base_flange[:3, 3], *Rotation.from_matrix(v.T_base_flange[:3, :3]).as_quat()] for v in session.views
        ]
        lines = [row + "".join(f",{x:.9f}" for x in pose) for row, pose in zip(rows, poses, strict=True)]
        (folder / "views.csv").write_text("\n".join([f"{header},{POSE}", *lines]) + "\n")
    text = (folder / "session.toml").read_text()
    stated = "payload = { com = [0, 0, 80] }\nrepeatability = { position = 0.05, rotation_mrad = 0.04 }\n"
    (folder / "session.toml").write_text(text + stated)
    return load_session(folder)


def written(session, folder, effects=("joint_offset",)):
    """robot.toml of a table that is said to be proved, and what the terminal shows of it."""
    found = run(session, effects=["joint_offset"])
    robot = calibrated_robot_of_run(found).robot if effects else session.robot
    table = LinkTable(robot, effects, 0.1, 0.2)
    folder.mkdir()
    write_robot(table, found, folder)
    show_robot(found, robot_document(found, table, [], ""), [], folder)
    return found, (folder / "robot.toml").read_text()


@pytest.mark.parametrize("reported", [True, False])
def test_a_session_that_follows_the_advice_has_the_new_arm(tmp_path, capsys, reported):
    """Reported poses stand before any table: as long as they are there nothing changes."""
    session = cell(tmp_path / "s", reported)
    found, text = written(session, tmp_path / "out")
    lines = [line for line in text.splitlines() if line.startswith("# Take x … qw out of views.csv")]
    assert len(lines) == reported and capsys.readouterr().err.count("Take x … qw out of views.csv") == reported
    file, views = tmp_path / "s" / "session.toml", tmp_path / "s" / "views.csv"
    file.write_text(file.read_text().split("[robot]")[0] + text)
    poses = [view.T_base_flange for view in load_session(tmp_path / "s").views]
    before = [view.T_base_flange for view in session.views]
    assert np.allclose(poses, before, atol=1e-6) == reported
    if reported:
        views.write_text("\n".join(",".join(row.split(",")[:7]) for row in views.read_text().split()) + "\n")
    again = load_session(tmp_path / "s")
    arm = calibrated_robot_of_run(found).robot
    np.testing.assert_allclose([v.T_base_flange for v in again.views], forward(arm, session.joints), atol=1e-6)


def test_what_the_nominal_table_states_beside_its_rows_stays(tmp_path):
    session = cell(tmp_path / "s", reported=False)
    _, text = written(session, tmp_path / "out")
    file = tmp_path / "s" / "session.toml"
    file.write_text(file.read_text().split("[robot]")[0] + text)
    again = load_session(tmp_path / "s")
    assert (again.repeatability.position, again.repeatability.rotation) == pytest.approx((0.05, 4e-5))
    np.testing.assert_array_equal(again.robot.payload_com, [0, 0, 80])
    none = replace(session, repeatability=StatedRepeatability())
    assert "repeatability" not in written(none, tmp_path / "none")[1]


def test_what_was_found_and_not_proved_is_named(tmp_path, capsys):
    """Offsets are in the model and not in the table: another error of the arm was found."""
    session = cell(tmp_path / "s", reported=True)
    found, text = written(session, tmp_path / "out", effects=())
    said = "Found, but not in it for want of proof: joint_offset; model.toml has it."
    assert f"# {said}\n" in text and said in capsys.readouterr().err
    assert "no other effect" not in text and "Take x" not in text
    assert "The model has no other effect of the arm." in written(session, tmp_path / "proved")[1]
    assert robot_document(found, LinkTable(session.robot, ()), [], "")["unproved"] == ["joint_offset"]
