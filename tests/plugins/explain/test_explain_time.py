"""Formulas of scans: a flange that swings, a joint that does, and a gear whose friction remembers where the joint turned."""

import re

import numpy as np
import pytest

from data_synth import kinematics
from stitch.effects.user_file import load
from stitch.numerics import frames
from stitch.plugins.explain.explain import explain
from tests.diagnosis.freed_blade import freed_blade

VIEWS = 18
# Of the flange in its own frame, rad and mm.
DIRECTION = np.array([2.2e-4, -1.5e-4, 2.8e-4, 0.08, 0.05, -0.07])


@pytest.fixture(scope="module")
def cell():
    return freed_blade(6, VIEWS)


@pytest.mark.slow
def test_a_flange_that_swings_gets_the_formula_of_a_swing(cell, tmp_path):
    seconds = cell.measurement.views.time
    period = seconds[-1] / 3.5
    swing = np.cos(2 * np.pi * seconds / period - 0.6)
    found = explain(cell.seen(cell.measured.T_base_flange @ frames.exp(2 * swing[:, None] * DIRECTION)))
    assert found.found and found.place in ("mount", "part")
    assert float(re.search(r"t/([0-9.]+) h", found.formula)[1]) == pytest.approx(period / 3600, rel=0.1)
    # The part is carried: it moves against the flange.
    assert found.heldout_share < 0.6
    (tmp_path / "mine.py").write_text(found.source)
    assert load(tmp_path / "mine.py") == ["explained"]


@pytest.mark.slow
def test_a_joint_that_swings_in_time_gets_the_formula_of_a_swing(cell):
    joints, seconds = cell.measured.plan.joints, cell.measurement.views.time
    period = seconds[-1] / 1.3
    error = np.zeros_like(joints)
    error[:, 4] = 5e-4 * np.cos(2 * np.pi * seconds / period - 0.6)
    found = explain(cell.seen(kinematics.flange(cell.measured.plan.arm, joints + error)))
    assert found.found and found.formula.startswith("q*5 = q5")
    # Half a turn of phase is the other sign.
    amplitude = float(re.search(r"([-+0-9.]+) rad · cos\(2π t/", found.formula)[1])
    assert abs(amplitude) == pytest.approx(5e-4, rel=0.2)
    assert float(re.search(r"t/([0-9.]+) h", found.formula)[1]) == pytest.approx(period / 3600, rel=0.1)


@pytest.mark.slow
def test_a_gear_with_friction_gets_the_formula_of_what_stays_behind(cell):
    joints = cell.measured.plan.joints
    driven, play, stays = joints[:, 2], 0.25 * np.ptp(joints[:, 2]), [joints[0, 2]]
    for q in driven[1:]:
        stays.append(np.clip(stays[-1], q - play, q + play))
    behind = np.array(stays) - driven
    error = np.zeros_like(joints)
    error[:, 2] = 5e-4 * behind / behind.std()
    found = explain(cell.seen(kinematics.flange(cell.measured.plan.arm, joints + error)))
    assert found.found and "behind q3" in found.formula, found.why


@pytest.mark.slow
def test_scatter_gets_no_formula(cell):
    assert not explain(cell.seen(cell.measured.T_base_flange)).found
