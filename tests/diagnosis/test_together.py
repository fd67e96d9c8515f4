"""What sessions of one arm with other loads decide together, where gravity and gears are one curve."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import flange, labelled_cell
from stitch.api.pipeline import run
from stitch.diagnosis.diagnose import linear_model_of
from stitch.diagnosis.together import decide_together, together_document, together_sentence

LOADS = (1.0, 6.0)


def loaded(kg, seed, of_load):
    """Joint 2 turns by the reach, times the load or not."""
    rng = np.random.default_rng(seed)
    joints = rng.uniform(-1.2, 1.2, (20, 6))
    reach = np.array([flange(q)[:2, 3] @ [np.cos(q[0]), np.sin(q[0])] for q in joints])
    errors = np.outer(4e-7 * reach * (kg if of_load else 3.0), np.eye(6)[1])
    session, *_ = labelled_cell(seed, views=20, errors=(errors, np.zeros((20, 6))))
    robot = replace(session.robot, payload_mass=kg)
    return linear_model_of(run(replace(session, robot=robot)))


@pytest.mark.parametrize("of_load", [True, False])
def test_gravity_is_named_where_it_grows_with_the_load_and_only_there(of_load):
    found = decide_together([loaded(kg, seed, of_load) for seed, kg in enumerate(LOADS)])
    assert (found.effects == ("joint_compliance",)) == of_load
    assert together_document(found, ["a", "b"])["verdict"] == found.verdict
    if of_load:
        (load,) = (p for p in found.candidates[0].parameters if p.name == "c2")
        assert load.value > 5 * load.sigma
        assert together_sentence(found).startswith("joint_compliance is missing (")
