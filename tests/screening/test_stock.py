"""Stock on one view, against nature's castings: said with its thickness; a displaced or torn view never is."""

import json
from dataclasses import replace

import numpy as np
import pytest

import stitch
from data_synth import kinematics
from data_synth.fixtures.blade_cells import blade_with_stock, measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.write import write_session
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.session.capture import prepare_capture

CELL = {"seed": 2, "views": 10, "pixels": 80}
VIEW = 8


@pytest.mark.usefixtures("no_drawing")
def test_stock_on_half_of_the_part_is_said_and_the_view_stays(tmp_path):
    """It is taken off where it is; a run that was saved knows it again. The pose is as near the truth as is stated."""
    measured = blade_with_stock(odd=[VIEW], stock=lambda along: 0.2 * (along <= 0.5), **CELL)
    write_session(tmp_path / "session", measured, "blade")
    found = stitch.run(stitch.load_session(tmp_path / "session"))
    (scan,) = (scan for scan in found.measurement.capture.scans if scan.stock is not None)
    assert found.session.names[found.measurement.capture.scans.index(scan)] == "v008"
    assert abs(scan.stock.thickness - 0.2) < 3 * scan.stock.sigma < 0.03
    assert found.left_out == ()
    assert "v008 shows its surface" in found.doubts[0] and "outside" in found.doubts[0]
    found.save(tmp_path / "run", recording=False)
    read = stitch.load_run(tmp_path / "run")
    (again,) = (s for s in read.measurement.capture.scans if s.stock is not None)
    assert again.stock.thickness == pytest.approx(scan.stock.thickness)
    assert np.mean(again.stock.points == scan.stock.points) > 0.98
    read.save(tmp_path / "again", recording=False)
    (row,) = json.loads((tmp_path / "again" / "result.json").read_text(encoding="utf-8"))["stock"]
    middle = frames.transform(found.poses[VIEW], scan.points.mean(axis=0)[None])[0]
    to_middle = frames.make(np.eye(3), -middle)
    off = frames.log(to_middle @ found.poses @ frames.inverse(to_middle @ measured.T_reference_scanner))
    error = off[VIEW] - np.delete(off, VIEW, axis=0).mean(axis=0)
    assert (np.abs(error) < 3 * np.array(row["pose_sigma"])).all()
    # As 20 µm of the arm, far less than the stock.
    assert max(row["pose_sigma"][3:]) < 0.03


@pytest.mark.parametrize("turn", [pytest.param(0.0, marks=pytest.mark.slow), 3e-3])
def test_a_displaced_view_is_never_called_stock(turn):
    measured = measured_blade(**CELL)
    T = np.array(measured.T_base_flange)
    T[VIEW] = T[VIEW] @ frames.exp(np.array([turn, 0, 0, 0.1, 0.2, -0.2]))
    found = run(session_of(replace(measured, T_base_flange=T)))
    assert not any("stock" in doubt for doubt in found.doubts)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.005, 0.02])
def test_poses_that_are_read_late_are_no_stock(share):
    """Each is read a share of the way from the one before, as the arm goes by its joints."""
    measured = measured_blade(9000, views=16, pixels=60)
    q = measured.plan.joints
    way = np.random.default_rng([9000, 3]).uniform(0, share, len(q))[:, None] * (np.roll(q, 1, axis=0) - q)
    true, read = (kinematics.flange(measured.scene.arm, joints) for joints in (q, q + way))
    found = run(session_of(replace(measured, T_base_flange=measured.T_base_flange @ frames.inverse(true) @ read)))
    assert not any("stock" in doubt for doubt in found.doubts)


def test_a_clean_session_has_no_stock():
    assert run(session_of(measured_blade(**CELL))).doubts == ()


def test_where_more_than_a_third_of_the_views_stand_off_nothing_is_taken_off():
    """No other says what their surface is: the scans stay as they were measured."""
    session = session_of(blade_with_stock(odd=(1, 3, 5, 8), stock=lambda along: 0.15 + 0 * along, **CELL))
    found = run(session)
    assert found.doubts == ()
    for scan, untouched in zip(found.measurement.capture.scans, prepare_capture(session).scans, strict=True):
        assert scan.stock is None and np.allclose(scan.points, untouched.points, atol=1e-9)
