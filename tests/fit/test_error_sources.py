"""Every source that a hand-eye's variance may have is said in words."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.quiet_scenes import clean, simulated
from stitch.api import pipeline
from stitch.fit.sentences import SOURCES, unfitted
from stitch.model.model import Model
from stitch.observations.linear_model import WHITE_COMPONENTS
from stitch.observations.pose_errors import STOP_COMPONENTS, prior_pose_errors, usual_sizes
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of


def test_every_component_has_words():
    """Of an arm of which all is known, and that stands twice at one pose."""
    session, T_mount, _ = labelled_cell(1, views=4)
    twice = (*session.views, replace(session.views[-1], name="again"))
    session = replace(session, robot=replace(session.robot, mass=np.ones(6)), views=twice)
    prior = prior_pose_errors([measurement_of(session, prepare_capture(session))], Model(T_mount), [np.zeros(3)])
    assert set(STOP_COMPONENTS) | set(usual_sizes()) <= set(prior.names)
    assert {*WHITE_COMPONENTS, *prior.names} <= set(SOURCES)
    assert len(set(SOURCES.values())) == len(SOURCES) and not set(SOURCES) & set(SOURCES.values())


@pytest.mark.slow
def test_joints_that_look_like_the_hand_eye_are_named_for_it():
    """Of a wrong zero of the last joint nothing is seen: rotation and position may come from it, not from the scanner."""
    session = session_of(simulated(clean("blade-table", rays=60), {"joint_offset": 1.0}, 2, 10))
    (note,) = [n for n in pipeline.run(session, effects=["joint_offset"]).notes if "larger than noise alone" in n]
    assert "rotation" in note and note.split("may come from ")[1].startswith(unfitted("joint_offset"))
