"""Sessions that do not share an arm are said not to; those that do are left alone."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import run_rig
from stitch.screening.model_transfer import compare_with_own_effects

OFFSETS = np.array([0, 8e-4, -9e-4, 0, 1e-3, 0])


def two_days(second):
    """Two sessions, the joints of the second off by so much (6,), rad."""
    found = [labelled_cell(50 + k, views=24, offset=off)[0] for k, off in enumerate((OFFSETS, second))]
    return [replace(session, name=f"day {k}") for k, session in enumerate(found)]


def test_two_arms_in_one_fit_are_doubted():
    runs = run_rig(two_days(-OFFSETS), effects=["joint_offset"])
    for k, r in enumerate(runs):
        assert any(f"day {k} does not share the effects of this rig" in doubt for doubt in r.doubts)


@pytest.mark.parametrize("effects", [["joint_offset"], ["joint_offset", "link_geometry"], []])
def test_one_arm_is_not(effects):
    assert not any("does not share" in doubt for r in run_rig(two_days(OFFSETS), effects=effects) for doubt in r.doubts)


@pytest.mark.parametrize(("shared", "alone", "large"), [(0.296, 0.279, False), (0.511, 0.501, False), (0.6, 0.3, True)])
def test_what_is_significant_is_said_only_where_it_is_large(shared, alone, large):
    """Of 600 views a twentieth of the rms is beyond chance too."""
    squares = np.random.default_rng(0).chisquare(3, 600) / 3
    found = compare_with_own_effects("day 1", shared**2 * squares, alone**2 * squares, 6)
    assert found.p_value < 1e-3 and found.large == large
    assert found.separate_rms < found.expected_rms < 1.01 * found.separate_rms
