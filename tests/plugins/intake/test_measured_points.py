"""Folders of trackers and motion capture, without scans, become the session of the cell that was measured."""

import numpy as np
import pytest

from data_synth.fixtures.tracker_folders import FOLDERS, tracked_arm
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.plugins.intake.measured_points import measured_session, write_measured
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.session.capture import prepare_capture
from stitch.session.reading.session_folder import load_session
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


def test_one_marker_that_was_recorded_is_paired_by_time(tmp_path):
    """While the arm stands for 0.8 s at every pose, and moves on in between."""
    arm = tracked_arm(34, 14)
    times, places = np.arange(0, 14, 0.02), arm.points[:, 0]
    between = np.stack([np.interp(times, np.arange(14) + 0.5, axis) for axis in places.T], axis=1)
    stands = np.abs(times % 1 - 0.5) < 0.4
    between[stands] = places[times[stands].astype(int)]
    np.savetxt(
        tmp_path / "marker.csv", np.column_stack([times, between]), "%.6f", ",", header="time [s],x,y,z", comments=""
    )
    poses = np.column_stack([np.arange(14) + 0.5, arm.T.reshape(-1, 16)])
    names = ",".join(["time", *(f"m{i}{k}" for i in range(4) for k in range(4))])
    np.savetxt(tmp_path / "robot.csv", poses, "%.9f", ",", header=names, comments="")
    made = measured_session(tmp_path, StatedFolder())
    write_measured(tmp_path / "made", made)
    found = closed_form_hand_eye(prepare_capture(load_session(tmp_path / "made")))
    assert np.linalg.norm(found[:3, 3] - arm.T_base_sensor[:3, 3]) < 0.3


def test_joints_without_the_robot_are_refused(tmp_path):
    FOLDERS["joints and a reflector in one table"](tmp_path, tracked_arm(33, 9))
    (tmp_path / "dh_parameters.csv").unlink()
    with pytest.raises(InputError, match="joint angles need the robot"):
        measured_session(tmp_path, StatedFolder())
