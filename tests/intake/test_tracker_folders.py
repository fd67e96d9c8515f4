"""Folders of trackers and motion capture, without scans, become the session of the cell that was measured."""

import numpy as np
import pytest

from data_synth.fixtures.tracker_folders import FOLDERS, tracked_arm
from stitch import frames
from stitch.errors import InputError
from stitch.intake.first_session import StatedFolder
from stitch.intake.measured_points import measured_session, write_measured
from stitch.measurement.capture import prepare_capture
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.reading.session_folder import load_session
from tests.needs import needs

SLOW = ("SpatialAnalyzer", "OptiTrack by time")


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.slow] * (k in SLOW)) for k in FOLDERS])
def test_a_folder_without_scans_becomes_its_session(tmp_path, kind):
    if kind == "workbook":
        needs("python_calamine", "formats")
        needs("openpyxl", "dev")
    arm, raw, out = tracked_arm(31), tmp_path / "raw", tmp_path / "made"
    raw.mkdir()
    FOLDERS[kind](raw, arm)
    made = measured_session(raw, StatedFolder())
    assert made is not None
    assert [guess.what for guess in made.guesses if not guess.determined] == []
    write_measured(out, made)
    session = load_session(out)
    assert session.mount == "eye_to_hand" and len(session.views) == len(arm.T)
    found = closed_form_hand_eye(prepare_capture(session))
    away = frames.log(frames.inverse(arm.T_base_sensor) @ found)
    if kind == "URDF with a rail":
        assert np.linalg.norm(found[:3, 3] - arm.T_base_sensor[:3, 3] - [0, 0, 100]) < 0.3
    else:
        assert np.linalg.norm(away[:3]) < 2e-4 and np.linalg.norm(away[3:]) < 0.3
    assert (session.robot is not None) == (kind in ("joints and a reflector in one table", "6D probe", "Vicon"))
    assert (session.views[-1].time_s is not None) == (kind in ("6D probe", "OptiTrack by time"))
    sigma = session.views[0].sighting.sigma
    stated = {"poses and reflectors by name": 0.03, "SpatialAnalyzer": 0.02}.get(kind)
    assert np.isnan(sigma).all() if stated is None else np.allclose(sigma, stated)


def test_what_does_not_belong_together_is_refused(tmp_path):
    arm = tracked_arm(32, 9)
    FOLDERS["geodetic, by order"](tmp_path, arm)
    table = tmp_path / "laser.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:-6]))
    with pytest.raises(InputError, match="30 points for 9 poses.*write the view's name"):
        measured_session(tmp_path, StatedFolder())


def test_joints_without_the_robot_are_refused(tmp_path):
    FOLDERS["joints and a reflector in one table"](tmp_path, tracked_arm(33, 9))
    (tmp_path / "dh_parameters.csv").unlink()
    with pytest.raises(InputError, match="joint angles need the robot"):
        measured_session(tmp_path, StatedFolder())
