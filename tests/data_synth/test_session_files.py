"""`stitch synth`: the same seed gives the same files, and they agree with what was measured."""

import json
from pathlib import Path

import numpy as np
import pytest

from data_synth import nature
from data_synth.commands import synth
from data_synth.fixtures.edits import edit
from data_synth.fixtures.quiet_scenes import clean
from data_synth.made_session import make, truth_path
from data_synth.simulate import simulate
from data_synth.write import write_session, write_truth
from stitch.errors import InputError, NoResultError
from stitch.session.reading.session_folder import load_session


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_same_seed_same_bytes_another_seed_others(small, tmp_path):
    for place, seed in (("a", 7), ("b", 7), ("c", 8)):
        synth(str(small), tmp_path / place / "s", ["joint_compliance=2", "third_harmonic"], seed)
    a, b, c = (contents(tmp_path / place) for place in "abc")
    assert set(a) == {
        "s/session.toml", "s/views.csv", "s/points.csv", "s/clouds/v000.ply", "s/clouds/v001.ply", "s/clouds/v002.ply",
        "s.truth.json", "s.truth.ply",
    }  # fmt: skip
    assert a == b
    # The part is the same whatever the seed, and so are the arm and the scanner; all that is measured differs.
    assert {name for name in a if a[name] == c[name]} == {"s.truth.ply"}


def test_truth_goes_where_it_is_told(small, tmp_path):
    synth(str(small), tmp_path / "s", ["mount_drift=0.5"], 1, None, tmp_path / "elsewhere" / "t.json")
    assert not truth_path(tmp_path / "s").exists()
    truth = json.loads((tmp_path / "elsewhere" / "t.json").read_text())
    assert (tmp_path / "elsewhere" / "t.ply").is_file()
    assert truth["seed"] == 1 and truth["scene"] == "small" and list(truth["hidden"]) == ["mount_drift"]
    # Nobody who reads the session learns what is hidden.
    session = contents(tmp_path / "s")
    assert not any(b"drift" in data or b"truth" in data for data in session.values())


def test_views_and_labelled_points_follow_the_option(small, tmp_path):
    synth(str(small), tmp_path / "s", [], 1, 4)
    session = load_session(tmp_path / "s")
    assert len(session.views) == 4
    assert session.sphere_radius == 30.0
    rows = (tmp_path / "s" / "points.csv").read_text().splitlines()
    assert rows[0] == "view,target,x,y,z,sigma" and len(rows) == 5


def test_session_can_be_read_back_and_agrees_with_what_was_measured(small, tmp_path):
    measured = make(small, {}, 3)
    write_session(tmp_path / "s", measured, "s")
    session = load_session(tmp_path / "s")
    assert session.mount == "eye_to_hand" and session.robot.n_joints == 6
    for view, cloud, T, q in zip(session.views, measured.clouds, measured.T_base_flange, measured.plan.joints,
                                 strict=True):  # fmt: skip
        assert np.array_equal(view.cloud.points, cloud.points)
        # Twelve digits: 1e-9 of a metre and of a radian.
        assert np.allclose(view.T_base_flange, T, atol=1e-6) and np.allclose(view.joints, q, atol=1e-9)


def test_line_scanner_writes_times_and_velocities(tmp_path):
    line = clean("line-sweep", rays=24)
    measured = simulate(line, {}, 0, 2)
    write_session(tmp_path / "s", measured, "s")
    header = (tmp_path / "s" / "views.csv").read_text().splitlines()[0].split(",")
    assert {f"j{i}_velocity_deg_s" for i in range(1, 8)} <= set(header)
    cloud = load_session(tmp_path / "s").views[0].cloud
    assert np.allclose(cloud.scalars["time"], measured.clouds[0].time, atol=1e-6)


def test_refuses_what_is_there_already(small, tmp_path):
    (tmp_path / "s").mkdir()
    with pytest.raises(InputError, match="exists already"):
        synth(str(small), tmp_path / "s")
    assert list((tmp_path / "s").iterdir()) == []


def test_one_view_is_too_few(small, tmp_path):
    with pytest.raises(InputError, match="--views 1"):
        synth(str(small), tmp_path / "s", [], 0, 1)


def test_a_part_out_of_reach_says_so_and_writes_nothing(small, tmp_path, monkeypatch):
    monkeypatch.setattr("data_synth.planning._ATTEMPTS", 3)
    edit(small, r"xyz = \[1450\.0, ", "xyz = [9000.0, ")
    with pytest.raises(NoResultError, match="view 0 cannot be reached"):
        synth(str(small), tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_truth_must_be_a_json_file(small, tmp_path):
    with pytest.raises(InputError, match=r"truth.ply.*\.json"):
        synth(str(small), tmp_path / "s", [], 0, None, tmp_path / "truth.ply")
    assert not (tmp_path / "s").exists()


def test_truth_is_all_there_is_of_a_hidden_law(small):
    """The quiet laws must not add to a hidden one: its fitted numbers are compared with the truth."""
    for name in nature.SMALL:
        laws, told = nature.draw({name: 1.0}, 1.0, make(small, {}, 0).plan, np.random.default_rng(0))
        assert [p for n, p in laws.laws if n == name] == [told[name]]


def test_write_truth_holds_every_number_a_judge_needs(small, tmp_path):
    measured = make(small, {"backlash": 1.0}, 3)
    write_truth(tmp_path / "t.json", measured, 3)
    truth = json.loads((tmp_path / "t.json").read_text())
    assert np.allclose(truth["hand_eye"], measured.T_mount) and np.allclose(
        truth["poses"], measured.T_reference_scanner
    )
    assert truth["hidden"]["backlash"] and truth["targets"] == {"ball1": [0.0, 0.0, 0.0]}
    # The stated hand-eye is off by what the scene says: 0.3° and 2 mm.
    difference = np.linalg.inv(measured.T_mount) @ measured.T_coarse
    angle = np.degrees(np.arccos((np.trace(difference[:3, :3]) - 1) / 2))
    assert angle == pytest.approx(0.3, rel=1e-6)
    # exp couples the two by half the angle: 2.6e-3 of the length.
    assert np.linalg.norm(difference[:3, 3]) == pytest.approx(2.0, rel=3e-3)
