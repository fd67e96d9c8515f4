"""What was found first gives way to effects that together do more, though beside it none of them is wanted."""

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.ranking import rank_one
from stitch.diagnosis.stepwise_selection import exchanged_set, is_better_set
from stitch.effects.contract import EFFECTS
from stitch.model.model import Model
from stitch.observations.targets.target_model import target_model
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of

TRUE = ("joint_offset", "joint_compliance")


@pytest.fixture(scope="module")
def arm():
    """An arm of which every joint counts from a wrong zero and joint 2 gives way, and what may be asked of it."""
    offset = 1e-3 * np.random.default_rng(0).standard_normal(6)
    session, T_mount, _ = labelled_cell(2, views=100, offset=offset, sag=1e-6)
    linear = target_model(measurement_of(session, prepare_capture(session)), Model(T_mount), None)
    asked = (*TRUE, "gear_eccentricity", "gear_harmonic", "backlash", "settling")
    candidates = {name: c for name in asked if (c := candidate_of(linear, EFFECTS[name])) is not None}
    return linear, list(candidates.values()), {name: rank_one(linear, c, len(asked)) for name, c in candidates.items()}


def test_an_imitation_gives_way_to_what_is_there(arm):
    linear, candidates, alone = arm
    stuck = [alone["gear_eccentricity"], alone["gear_harmonic"]]
    found = exchanged_set(linear, candidates, stuck)
    assert {c.name for c in found} == set(TRUE)
    right = [alone[name] for name in TRUE]
    assert is_better_set(linear, right, stuck) and not is_better_set(linear, stuck, right)


def test_what_is_there_stays(arm):
    linear, candidates, alone = arm
    assert exchanged_set(linear, candidates, [alone[name] for name in TRUE]) == []
