"""What a run says: every source of a hand-eye's variance in words, and on how little U of few views rests."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.quiet_scenes import clean, simulated
from stitch.api import pipeline
from stitch.fit.coarse import CoarseHandEye
from stitch.fit.sentences import SOURCES, unfitted, warnings
from stitch.model.model import Model
from stitch.observations.linear_model import WHITE_COMPONENTS
from stitch.observations.pose_errors import STOP_COMPONENTS, prior_pose_errors, usual_sizes
from stitch.observations.surfaces.hand_eye_fit import HandEyeFit
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of

FIT = HandEyeFit(np.eye(4), np.eye(6), 1.0, (), 1.0)


START = CoarseHandEye(np.eye(4), 1.0, "stated", ())


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


@pytest.mark.parametrize(("views", "said"), [(4, True), (6, True), (7, False), (18, False)])
def test_few_degrees_of_freedom_are_said_with_their_number(views, said):
    """Views show six numbers each, less what all have in common and the hand-eye."""
    notes = warnings(START, replace(FIT, degrees=6 * views - 12))
    assert any(f"rests on {6 * views - 12} degrees" in note for note in notes) == said


def test_a_covariance_of_another_run_is_not_said_to_rest_on_few_views():
    assert not warnings(START, FIT)
