"""Cells with external axes, stated wrongly or not at all, against the truth of a second kinematics."""

import numpy as np
import pytest

import stitch
from data_synth.cells.axis_cell import axis_cell, write_cell
from stitch.numerics import frames
from stitch.session.axis_poses import require_placed


def run_of(folder, kind, seed, *, known, hidden=None):
    """The run of a cell whose axes are stated a millimetre and a milliradian off, or not at all."""
    cell = axis_cell(kind, seed, hidden)
    tables = []
    for axis in cell.axes:
        direction, point = cell.stated(axis)
        across = np.linalg.svd(direction[None])[2][1]
        table = {"direction": (direction + 1e-3 * across).tolist()}
        tables.append(table | ({"point": (point + across).tolist()} if axis.kind == "rotary" else {}) if known else {})
    write_cell(folder / "s", cell, tables)
    return cell, stitch.run(stitch.load_session(folder / "s"))


def require_true(cell, run):
    for axis, place in zip(cell.axes, run.axes, strict=True):
        direction, point = cell.stated(axis)
        assert np.linalg.norm(place.direction - direction) < 3 * np.linalg.norm(place.direction_sigma)
        if place.point is not None:
            assert np.linalg.norm(np.cross(direction, place.point - point)) < 3 * np.linalg.norm(place.point_sigma)
    if cell.T_base_flange is not None:
        off = frames.log(frames.inverse(cell.T_mount) @ run.T_mount)
        chi2 = off @ np.linalg.solve(run.mount_covariance, off)
        assert chi2 < 22.5  # 0.1 % of six degrees of freedom


def test_a_turntable_alone_is_placed_and_read_again(tmp_path):
    cell, run = run_of(tmp_path, "turntable", 31, known=True)
    require_true(cell, run)
    assert run.session.reference_frame == "table" and "z" in run.unknown
    folder = run.save(tmp_path / "run", recording=False)
    again = stitch.load_run(folder)
    assert np.allclose(again.axes[0].point, run.axes[0].point, atol=1e-9)
    assert np.allclose(again.axes[0].point_sigma, run.axes[0].point_sigma, rtol=1e-6)
    assert np.allclose(again.fit.poses_model, run.fit.poses_model, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["table-arm", "rail-arm", "tilt-turn"])
@pytest.mark.parametrize("known", [True, False])
def test_axes_are_found_beside_the_hand_eye(tmp_path, kind, known):
    require_true(*run_of(tmp_path, kind, 32, known=known))


@pytest.mark.slow
def test_a_wobbling_table_is_named_and_added(tmp_path):
    _, run = run_of(tmp_path, "table-arm", 33, known=True, hidden={"axis_wobble": 1.0})
    assert stitch.diagnose(run).effects == ("axis_wobble",)
    assert stitch.add(run, "axis_wobble").heldout_rms < 0.95 * run.heldout_rms


def test_what_does_not_fit_axes_asks_for_their_place(tmp_path):
    cell = axis_cell("table-arm", 5, views=3, pixels=20)
    write_cell(tmp_path / "s", cell, [{}], cell.T_mount)
    with pytest.raises(stitch.InputError, match="nobody says where axis table stands; to fix: `stitch run` finds it"):
        require_placed(stitch.load_session(tmp_path / "s"))
