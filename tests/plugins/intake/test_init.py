"""stitch init at the command line: what it writes, asks and refuses.

Folders of trackers and motion capture, without scans, become the session of the cell that was measured.
"""

import json

import numpy as np
import pytest

from data_synth.fixtures.raw_folders import Convention, raw_folder
from data_synth.fixtures.tracker_folders import FOLDERS, tracked_arm
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.plugins.intake.measured_points import measured_session, write_measured
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.session.capture import prepare_capture
from stitch.session.reading.session_folder import load_session
from tests.command_line import ended
from tests.needs import needs

SLOW = ("SpatialAnalyzer", "OptiTrack by time", "Leica's text", "geodetic, by order")


@pytest.fixture
def raw(session, tmp_path):
    """Three views of a simulated cell as a raw folder."""
    return raw_folder(session, tmp_path / "raw", Convention())


STATED = [
    "--rotation",
    "xyz-extrinsic",
    "--angles",
    "rad",
    "--unit",
    "mm",
    "--cloud-unit",
    "mm",
    "--mount",
    "eye_to_hand",
]


def test_what_is_stated_is_taken(raw, session, tmp_path):
    document = json.loads(ended("init", raw, *STATED, "--no-inverse", "--yes", "--json", "-o", tmp_path / "made").out)
    assert document["views"] == 3 and {g["what"] for g in document["guesses"]} >= {"rotation", "mount", "pairing"}
    assert all(g["because"] in ("file", "scans", "usual") for g in document["guesses"])
    (poses,) = [entry for entry in document["inventory"] if entry["taken_for"] == "poses"]
    assert poses["rows"] == 3 and document["question"] is None and document["not_used"] == []
    made, true = load_session(tmp_path / "made"), load_session(session)
    for a, b in zip(made.views, true.views, strict=True):
        assert abs(a.T_base_flange - b.T_base_flange).max() < 1e-3
    assert not (raw / "session.toml").exists()
    refused = ended("init", raw, *STATED, "--yes", "-o", tmp_path / "made", code=2)
    assert "exists already; to fix: replace it with --force" in refused.err
    ended("init", raw, *STATED[:-1], "eye_in_hand", "--yes", "-o", tmp_path / "made", "--force")
    assert load_session(tmp_path / "made").mount == "eye_in_hand"
    comment = (tmp_path / "made" / "session.toml").read_text(encoding="utf-8")
    assert "--force, with the flag" in comment and "(--rotation" in " ".join(comment.split())


def second_table(raw):
    """Other poses beside those of the clouds."""
    (raw / "robot.txt").write_text((raw / "RobotPoses.dat").read_text().replace("0.", "0.1"))


def test_what_is_only_guessed_is_known_to_the_session_until_a_person_states_otherwise(raw, tmp_path):
    ended("init", raw, *STATED, "--no-inverse", "--yes", "-o", tmp_path / "made")
    assert load_session(tmp_path / "made").usual == {}
    toml = tmp_path / "made" / "session.toml"
    guessed = "# ? cloud_unit: mm; scans are 150 long\n# ? rotation: xyz-extrinsic, radians; told by\n"
    toml.write_text(guessed + toml.read_text())
    assert load_session(tmp_path / "made").usual == {"cloud_unit": "mm", "rotation": "xyz-extrinsic"}
    toml.write_text(toml.read_text().replace('cloud_unit = "mm"', 'cloud_unit = "cm"'))
    assert load_session(tmp_path / "made", scans=False).usual == {"rotation": "xyz-extrinsic"}


def test_a_box_leaves_out_what_stands_still_before_the_scanner(raw, session, tmp_path):
    clouds = [view.cloud.points for view in load_session(session).views]
    low, high = (np.quantile(np.concatenate(clouds), share, axis=0) for share in (0.1, 0.9))
    box = f"--within={','.join(f'{x:.6f}' for x in (*low, *high))}"
    ended("init", raw, *STATED, "--no-inverse", "--yes", box, "-o", tmp_path / "made")
    for view, points in zip(load_session(tmp_path / "made").views, clouds, strict=True):
        assert view.cloud.count == ((points > low) & (points < high)).all(axis=1).sum() < len(points)
    assert "the lowest and the highest corner" in ended("init", raw, "--within", "1,1,1,0,0,0", code=2).err


@pytest.fixture
def contradicted(raw):
    """The raw folder with poses that fit no scans."""
    (raw / "RobotPoses.dat").write_text("".join(f"0.{i},0.3,-0.{i},100,200,{300 + i}\n" for i in range(3)))
    return raw


@pytest.mark.slow
def test_poses_that_fit_no_scans_make_no_session(contradicted):
    told = ended("init", contradicted, "--yes", code=2).err
    assert "no session was written" in told and "Next" not in told
    assert not (contradicted / "session.toml").exists()


@pytest.mark.slow
def test_without_a_terminal_what_cannot_be_told_is_asked_for_by_its_flag(contradicted):
    told = ended("init", contradicted, code=2).err
    assert "--rotation" in told and "--mount" in told and "--yes" in told
    assert not (contradicted / "session.toml").exists() and not (contradicted / "views.csv").exists()


@pytest.mark.slow
def test_a_terminal_is_asked_what_cannot_be_told(contradicted, monkeypatch):
    # A typing error costs a question, not the work so far.
    answers = iter(["zyx-intrinsik", "", "", "zyx-intrinsic", "", "eye_in_hand", "y"])
    asked = []
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    told = lambda text, err, default="": asked.append(text) or next(answers) or default  # noqa: E731
    monkeypatch.setattr("typer.prompt", told)
    monkeypatch.setattr("typer.confirm", lambda text, default, err: next(answers) == "y")
    err = ended("init", contradicted).err
    first = ["rotation", "length_unit", "mount"]
    assert [text.split()[0] for text in asked] == [*first, "--rotation", *first[1:]]
    assert "--rotation zyx-intrinsik" in err
    text = (contradicted / "session.toml").read_text(encoding="utf-8")
    assert "zyx-intrinsic" in text and 'mount = "eye_in_hand"' in text


def test_a_terminal_is_asked_one_question_in_place_of_a_refusal(raw, monkeypatch):
    """Eight columns of which two are something else: they are shown, numbered, and named by an answer."""
    table = raw / "RobotPoses.dat"
    table.write_text("".join(f"{i}.5,7.25,{row}\n" for i, row in enumerate(table.read_text().splitlines())))
    asked = []
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("typer.prompt", lambda text, err: asked.append(text) or "-,-,rx,ry,rz,x,y,z")
    monkeypatch.setattr("typer.confirm", lambda text, default, err: True)
    err = ended("init", raw, *STATED, "--no-inverse").err
    assert asked == ["--columns"]
    assert "hold no pose that is known" in err and any(line.split()[:3] == ["1", "2", "3"] for line in err.splitlines())
    assert load_session(raw).views


@pytest.mark.parametrize(
    ("spoil", "arguments", "told"),
    [
        (lambda raw: (raw / "session.toml").write_text(""), (), "exists already"),
        (lambda raw: (raw / "RobotPoses.dat").unlink(), (), "--poses"),
        (lambda raw: [f.unlink() for f in raw.glob("*.ply")], (), "no clouds there, only 1 .dat"),
        (lambda raw: [f.rename(f.with_suffix(".zip")) for f in raw.glob("*.ply")], (), "unpack it"),
        (second_table, STATED, "several lists"),
        (lambda raw: None, ("--rotation", "zyx"), "--rotation zyx: to fix: use xyz-intrinsic"),
        (lambda raw: None, ("--columns", "x,y,z"), "3 names"),
        (lambda raw: None, ("--columns", "x,x,z,rx,ry,rz"), "x stands twice"),
        (lambda raw: None, ("--poses", "nowhere.csv"), "nowhere.csv: no such file"),
        (lambda raw: (raw / "RobotPoses.dat").write_text("1,2,3,4,5,6\n" * 9), (), "3 clouds and 9 poses"),
    ],
)
def test_what_cannot_be_a_session_is_refused_in_one_line(raw, spoil, arguments, told):
    spoil(raw)
    out, err = ended("init", raw, "--yes", *arguments, code=2)
    assert told in err and not out
    assert len(err.strip().splitlines()) == 1 and "Traceback" not in err


@pytest.mark.parametrize("arguments", [STATED[:-2], ("--rows", "1-2")])
def test_a_question_is_asked_in_the_json_with_what_is_known_by_then(raw, arguments):
    """Without --yes nobody guesses: what cannot be told is the question, and nothing is written."""
    out, err = ended("init", raw, "--json", *arguments, code=2)
    told = json.loads(out)
    assert "stitch:" in err and not (raw / "session.toml").exists()
    assert {"guesses", "inventory", "not_used", "question"} <= set(told)
    assert set(told["question"]) >= {"what", "options"}
    assert [set(row) for row in told["inventory"]] == [{"file", "list", "rows", "columns", "taken_for", "why_not"}]
    assert bool(told["guesses"]) is not arguments


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
