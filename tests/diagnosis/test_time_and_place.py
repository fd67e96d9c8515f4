"""A jump at the view where a joint turns back has two possible causes, and both are said."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import scatter_limit
from stitch.effects.contract import EFFECTS
from stitch.model.model import Model
from stitch.observations.targets.target_model import target_model
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of

VIEWS, TURNS = 48, 30
JUMP = np.array([3e-4, -2e-4, 4e-4, 0.15, 0.1, -0.2])  # rad, mm


def evidence_of(third_joint):
    """What is said of a part that sits otherwise from a view on, where joint 3 comes from these sides (V,)."""
    moved = np.outer(np.arange(VIEWS) >= TURNS, JUMP)
    session, T_mount, _ = labelled_cell(3, views=VIEWS, errors=(np.zeros((VIEWS, 6)), moved))
    sides = np.random.default_rng(0).choice([-1.0, 1.0], (VIEWS, 6))
    sides[:, 2] = third_joint
    views = tuple(replace(view, approach=side) for view, side in zip(session.views, sides, strict=True))
    session = replace(session, views=views)
    linear = target_model(measurement_of(session, prepare_capture(session)), Model(T_mount), None)
    asked = ("part_slip", "backlash", "joint_offset")
    candidates = [c for name in asked if (c := candidate_of(linear, EFFECTS[name])) is not None]
    return gather_evidence(linear, candidates, scatter_limit(session))


ONCE = np.where(np.arange(VIEWS) < TURNS, 1.0, -1.0)


def test_a_jump_where_a_joint_turns_back_once_may_be_either():
    found = evidence_of(ONCE)
    assert found.verdict == "cannot_tell" and [r.name for r in found.named] == ["part_slip", "backlash"]
    assert found.coincidence == "part_slip begins at view v30, and from there on joint 3 comes from the other side"


@pytest.mark.parametrize(
    "third_joint", [np.where(np.arange(VIEWS) < TURNS - 8, 1.0, -1.0), ONCE * (-1.0) ** np.arange(VIEWS)]
)
def test_a_jump_that_no_joint_follows_is_one_in_time(third_joint):
    """The joint turns back eight views earlier, or to and fro all the time."""
    found = evidence_of(third_joint)
    assert found.verdict == "missing_effect" and [r.name for r in found.named] == ["part_slip"]
