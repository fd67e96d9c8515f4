"""Frames sessions: base and tool from a real tracker, both mounts, and refusals."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.cli import main as cli
from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.plugins.metrology.calibrate.tracker import calibrate_tracker, tracker_document
from stitch.session.reading.session_folder import load_session

HEADER = "view,x,y,z,qx,qy,qz,qw"


def table(poses, header=HEADER, extra=""):
    rows = [header]
    for k, (T, q) in enumerate(zip(poses, frames.to_quaternion(poses), strict=True)):
        rows.append(f"v{k}," + ",".join(f"{x:.12g}" for x in (*T[:3, 3], *q)) + extra)
    return "\n".join(rows) + "\n"


def session(folder, mount, seed=0, count=40, noise=1.0, turn=None):
    """A frames session with known sensor pose, and the true hand-eye."""
    rng = np.random.default_rng(seed)
    sensor, other = (frames.make(Rotation.random(rng=rng).as_matrix(), rng.normal(0, s, 3)) for s in (900, 80))
    R = Rotation.random(count, rng=rng) if turn is None else Rotation.from_rotvec(rng.uniform(-1, 1, (count, 1)) * turn)
    T = frames.make(R.as_matrix(), rng.normal(0, 400, (count, 3)) + np.array([900, 0, 600]))
    if mount == "eye_to_hand":
        hand_eye, measured = sensor, frames.inverse(sensor) @ T @ other
    else:
        hand_eye, measured = other, frames.inverse(T @ other) @ sensor
    measured = measured @ frames.exp(rng.normal(0, 1, (count, 6)) * noise * np.array([1e-4] * 3 + [0.05] * 3))
    folder.mkdir()
    (folder / "session.toml").write_text(
        f'format = "stitch-session/1"\nname = "f"\nlength_unit = "mm"\nmount = "{mount}"\n[scanner]\nnoise = 0.05\n'
    )
    (folder / "views.csv").write_text(table(T))
    (folder / "frames.csv").write_text(table(measured))
    return hand_eye


def test_real_tracker(shared_data):
    """1,495 poses of a UR10: base and tool alone leave 1.03 mm in the position of views left out."""
    loaded = load_session(shared_data / "ur10-tmac")
    document = tracker_document(calibrate_tracker(loaded), loaded)
    assert document["heldout_position_error"]["mean"] == pytest.approx(1.03, abs=0.005)
    assert document["views"] == 1495
    assert any("times the sensor's noise" in note for note in document["notes"])
    # The probe sits on the flange's axis, by two ways of solving.
    assert max(c["translation"] for c in document["closed_forms"].values()) < 1.0


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_error_is_that_of_the_covariance(mount, tmp_path):
    squares = []
    for seed in range(20):
        truth = session(tmp_path / f"s{seed}", mount, seed)
        loaded = load_session(tmp_path / f"s{seed}")
        document = tracker_document(calibrate_tracker(loaded), loaded)
        xi = frames.log(frames.inverse(np.array(document["hand_eye"])) @ truth)
        squares.append(xi @ np.linalg.solve(np.array(document["hand_eye_covariance"]), xi))
    assert 3.5 < np.mean(squares) < 8.5


@pytest.mark.parametrize("as_json", [True, False])
def test_command(as_json, tmp_path, capsys):
    truth = session(tmp_path / "s", "eye_to_hand")
    with pytest.raises(SystemExit) as ended:
        cli.main(["calibrate", "tracker", str(tmp_path / "s"), *(["--json"] if as_json else [])])
    assert ended.value.code == 0
    out = capsys.readouterr()
    if as_json:
        assert np.abs(np.array(json.loads(out.out)["hand_eye"]) - truth).max() < 0.5
    else:
        assert out.out == "" and "T_base_scanner" in out.err


def test_poses_turned_about_one_axis_are_refused(tmp_path):
    session(tmp_path / "s", "eye_to_hand", turn=np.array([0, 0, 1.0]))
    with pytest.raises(NoResultError, match="one axis"):
        calibrate_tracker(load_session(tmp_path / "s"))


def test_frames_of_other_views_are_refused(tmp_path):
    session(tmp_path / "s", "eye_to_hand")
    file = tmp_path / "s" / "frames.csv"
    head, *rows = file.read_text().splitlines()
    names = [row.split(",", 1)[0] for row in rows]
    file.write_text("\n".join([head, *(f"{n},{r.split(',', 1)[1]}" for n, r in zip(names, rows[::-1], strict=True))]))
    with pytest.raises(NoResultError, match="do not fit together"):
        calibrate_tracker(load_session(tmp_path / "s"))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t.replace("qw", "w", 1), r"line 1: no column 'qw'"),
        (lambda t: t.replace("v3,", "v2,"), r"line 5: view v2 stands on line 4 already"),
        (lambda t: t.replace("v3,", "w3,"), r"line 5: view 'w3' is not in views.csv"),
        (lambda t: t.replace("v3,", "v3,nan,"), r"line 5: 9 cells, the header has 8"),
        (lambda t: HEADER + "\n", r"no poses"),
        (lambda t: t.splitlines()[0] + "\nv0,1,2,3,0,0,0,2\n", r"length 2.0000, not a rotation"),
        (lambda t: t.splitlines()[0] + "\nv0,1,2,x,0,0,0,1\n", r"z is 'x'; write a finite number"),
    ],
)
def test_bad_frames_name_line_and_mend(spoil, message, tmp_path):
    session(tmp_path / "s", "eye_to_hand", count=6)
    file = tmp_path / "s" / "frames.csv"
    file.write_text(spoil(file.read_text()))
    with pytest.raises(InputError, match=message):
        calibrate_tracker(load_session(tmp_path / "s"))
