"""Two effects that are both missing: found beside each other, and none invented beside one."""

import numpy as np
import pytest

from data_synth import kinematics
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.evidence import find_missing_pair, pair_is_validated
from stitch.diagnosis.ranking import is_certain, rank_all
from stitch.effects.contract import EFFECTS
from stitch.numerics import frames
from tests.diagnosis.freed_blade import freed_blade

ASKED = ("joint_offset", "link_geometry", "gear_eccentricity", "backlash", "settling", "mount_drift", "fixture_drift")


@pytest.fixture(scope="module")
def cell():
    """A blade on the flange and its freed views under the true hand-eye."""
    return freed_blade(4, 14)


def best_of(cell, play, drift):
    """Model, candidates and the likeliest of them where joint 5 has play (rad) and the flange drifts (mm a view)."""
    measured, views = cell.measured, cell.measurement.views
    off = np.zeros_like(measured.plan.joints)
    off[:, 4] = play * views.approach[:, 4]
    drifts = frames.exp(np.arange(views.count)[:, None] * drift * np.array([0, 0, 0, 0, 1.0, 0]))
    linear = cell.seen(drifts @ kinematics.flange(measured.plan.arm, measured.plan.joints + off))
    candidates = [c for name in ASKED if (c := candidate_of(linear, EFFECTS[name])) is not None]
    best = rank_all(linear, candidates)[0][0]
    assert is_certain(best)
    return linear, candidates, best


def test_two_effects_are_found_beside_each_other_and_hold(cell):
    linear, candidates, best = best_of(cell, play=4e-4, drift=0.03)
    pair = find_missing_pair(linear, candidates, best)
    assert pair is not None and {r.name for r in pair} == {"backlash", "mount_drift"}
    assert pair_is_validated(linear, pair)
    score = next(r.score for r in pair if r.name == "backlash")
    found = dict(zip((p.name for p in score.form.free), score.values, strict=True))
    # q* = q − b·approach
    assert found["b5"] == pytest.approx(-4e-4, rel=0.3)


@pytest.mark.parametrize(("play", "drift"), [(6e-4, 0.0), (0.0, 0.05)])
def test_beside_one_effect_there_is_no_other(cell, play, drift):
    assert find_missing_pair(*best_of(cell, play=play, drift=drift)) is None
