"""A table of links fitted for itself: better than the nominal arm where it can be, the nominal one where it cannot."""

import json
from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import run
from stitch.cli.main import main
from stitch.plugins.metrology.calibrate.robot import link_table
from stitch.session.reading.session_folder import load_session
from stitch.session.robot import forward

OFFSET = np.array([0, 1.2e-3, -1.5e-3, 0, 1e-3, 0])
SAG = 1.5e-6  # rad/mm: gravity, which no table holds


def rms_with(robot, seed, **arm):
    """In a session of its own of the same arm, of which a table reports the poses."""
    session, *_ = labelled_cell(seed, views=60, **arm)
    views = tuple(replace(view, T_base_flange=forward(robot, view.joints)) for view in session.views)
    return run(replace(session, robot=robot, views=views)).residual_rms


def test_a_table_beside_which_gravity_stays_is_better_than_the_nominal_arm():
    """In poses and with a sensor that took no part, and as much better as it says."""
    session, *_ = labelled_cell(11, views=80, offset=OFFSET, sag=SAG)
    found = link_table(session)
    assert found.effects and found.heldout_rms < found.nominal_rms
    elsewhere = [rms_with(robot, 12, offset=OFFSET, sag=SAG) for robot in (found.robot, session.robot)]
    assert elsewhere[0] < elsewhere[1]
    assert elsewhere == pytest.approx([found.heldout_rms, found.nominal_rms], rel=0.35)
    assert "Fitted for the table alone and read back" in found.sentence("mm")


def test_half_of_a_range_serves_the_other_half():
    """Calibrated where joint 2 is below zero, judged where it is above."""
    session, *_ = labelled_cell(21, views=160, offset=OFFSET, sag=SAG)
    below = session.without([view.name for view in session.views if view.joints[1] > 0])
    above = session.without([view.name for view in session.views if view.joints[1] <= 0])
    found = link_table(below)
    views = tuple(replace(view, T_base_flange=forward(found.robot, view.joints)) for view in above.views)
    assert run(replace(above, robot=found.robot, views=views)).residual_rms < 0.7 * run(above).residual_rms
    assert found.ranges[1, 1] <= 0


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_of_a_right_arm_the_nominal_table_stays(seed):
    session, *_ = labelled_cell(60 + seed, views=40)
    found = link_table(session)
    assert not found.effects and found.robot is session.robot
    assert found.sentence("mm").startswith("No table of links is better than the nominal one")


def test_too_few_views_prove_nothing():
    session, *_ = labelled_cell(3, views=6, offset=OFFSET)
    found = link_table(session)
    assert not found.effects and "too few" in found.sentence("mm")


@pytest.mark.slow
def test_rows_without_a_sighting_prove_nothing():
    """They say from where the arm came, and are no perfect views: the rms is that of the views that show something."""
    session, *_ = labelled_cell(13, views=32, offset=OFFSET)
    rows = [(view, replace(view, name=f"{view.name}-moved", sighting=None)) for view in session.views]
    found = link_table(replace(session, views=tuple(view for both in rows for view in both)))
    alone = link_table(session)
    assert found.effects == alone.effects
    assert (found.heldout_rms, found.nominal_rms) == pytest.approx((alone.heldout_rms, alone.nominal_rms), rel=1e-3)


def test_the_command_says_what_the_table_is_worth_and_writes_it(tmp_path, capsys, few_effects):
    session, *_ = labelled_cell(11, views=60, offset=OFFSET, sag=SAG)
    folder = write_labelled(tmp_path / "s", session)
    with pytest.raises(SystemExit) as stop:
        main(["calibrate", "robot", str(folder), "-o", str(tmp_path / "out"), "--json"])
    assert not stop.value.code
    table = json.loads(capsys.readouterr().out)["table"]
    assert table["effects"] == ["joint_offset"] and table["heldout_rms"] < table["nominal_heldout_rms"]
    text = (tmp_path / "out" / "robot.toml").read_text()
    assert f"# {table['sentence']}\n" in text and "# Proved for j1 -6" in text
    # As a person would use it: put into the session in place of the nominal table.
    head, _ = (folder / "session.toml").read_text().split("[robot]")
    (folder / "session.toml").write_text(head + text)
    read = load_session(folder)
    assert run(read).residual_rms < 0.8 * run(session).residual_rms
    assert np.abs(forward(read.robot, session.joints) - forward(session.robot, session.joints)).max() > 0.1
