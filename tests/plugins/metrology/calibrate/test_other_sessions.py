"""An arm's model on another day: what holds there stays, what makes it worse is taken out or refused."""

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import change, run
from stitch.cli.main import main
from stitch.errors import InputError
from stitch.model.model_toml import arm_model
from stitch.output.result_document import model_of
from stitch.plugins.metrology.calibrate.other_sessions import UNASKED, keep_what_holds, prove, require_held
from stitch.plugins.metrology.calibrate.robot import link_table

OFFSET = np.array([0, 1.2e-3, -1.5e-3, 0, 1e-3, 0])
GEARS = np.array([0, 8e-4, 8e-4, 0, 0, 0])


def of_one_day(q):
    """An error of gears of joints 2 and 3 that the other day has not."""
    return GEARS * np.sin(q)


@pytest.fixture(scope="module")
def days():
    """The arm that is off in its zeros on both days, and in its gears on the first alone."""
    return labelled_cell(31, views=60, offset=OFFSET, gears=of_one_day)[0], labelled_cell(32, views=60, offset=OFFSET)[
        0
    ]


@pytest.fixture(scope="module")
def calibrated(days):
    return change(run(days[0]), ["joint_offset", "gear_eccentricity"])


def test_what_holds_on_both_days_stays_and_the_rest_is_fitted_without_the_other(days, calibrated):
    proved = keep_what_holds(calibrated, [days[1]])
    assert proved.run.effects == ["joint_offset"]
    (taken_out,) = proved.taken_out
    assert taken_out.startswith("Taken out: gear_eccentricity, which holds on cell alone")
    (proof,) = proved.proofs
    assert not proof.worse and proof.rms < 0.7 * proof.nominal_rms
    # By itself: the other day run with that arm, and without one.
    assert run(days[1], arm=arm_model(model_of(proved.run))).residual_rms == pytest.approx(proof.rms, rel=0.1)
    assert run(days[1]).residual_rms == pytest.approx(proof.nominal_rms, rel=0.1)


def test_a_right_arm_keeps_its_effects(days):
    here, there = labelled_cell(33, views=60, offset=OFFSET)[0], days[1]
    proved = keep_what_holds(change(run(here), ["joint_offset"]), [there])
    assert proved.run.effects == ["joint_offset"] and not proved.taken_out


def test_an_arm_that_makes_another_day_worse_is_refused(days):
    wrong = arm_model(model_of(change(run(labelled_cell(34, 60, gears=of_one_day)[0]), ["gear_eccentricity"])))
    right = labelled_cell(35, views=60)[0]
    assert prove(wrong, [right])[0].worse
    with pytest.raises(InputError, match="makes another session worse.*calibrate robot SESSION --on cell"):
        require_held(wrong, [right])


def test_nothing_is_claimed_of_other_days_where_none_was_asked(calibrated):
    proved = keep_what_holds(calibrated, [])
    assert proved.run is calibrated and proved.sentences == [UNASKED]


def test_a_table_that_is_worse_on_another_day_is_not_written():
    """Calibrated with zeros that were set anew before the other day."""
    here, there = labelled_cell(36, views=80, offset=OFFSET)[0], labelled_cell(37, views=60)[0]
    assert link_table(here).effects
    table = link_table(here, [there])
    assert not table.effects and table.robot is here.robot
    assert table.sentence("mm").startswith("The best table leaves")


def test_the_command_says_what_was_proved_where(tmp_path, capsys, days):
    for name, seed in (("monday", 41), ("tuesday", 42)):
        write_labelled(tmp_path / name, labelled_cell(seed, views=40, offset=OFFSET)[0])
    arguments = ["calibrate", "robot", str(tmp_path / "monday"), "--on", str(tmp_path / "tuesday"), "-o"]
    with pytest.raises(SystemExit) as stop:
        main([*arguments, str(tmp_path / "arm")])
    assert not stop.value.code
    said = " ".join("".join(capsys.readouterr()).split())
    assert "On session tuesday, which took no part, it leaves" in said
    assert "The model: On session tuesday" in (tmp_path / "arm" / "robot.toml").read_text()
    with pytest.raises(SystemExit) as stop:
        main(["export", str(tmp_path / "arm"), "--to", "arm-dh", "--on", str(tmp_path / "tuesday")])
    assert not stop.value.code
    assert "On session tuesday" in " ".join("".join(capsys.readouterr()).split())
