"""The corrected hand-eye on scans of cells of known truth.

What a run says: every source of a hand-eye's variance in words, and on how little U of few views rests.
"""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured_blade, disturbed
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.quiet_scenes import clean, simulated
from stitch.api import pipeline
from stitch.errors import NoResultError
from stitch.fit.coarse import CoarseHandEye
from stitch.fit.correct import correct
from stitch.fit.sentences import SOURCES, unfitted, warnings
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.observations.linear_model import WHITE_COMPONENTS
from stitch.observations.pose_errors import STOP_COMPONENTS, prior_pose_errors, usual_sizes
from stitch.observations.surfaces.hand_eye_fit import HandEyeFit
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.session.capture import part_size, prepare_capture
from stitch.session.measurement import measurement_of
from tests.fit.at_part import at_part

FIT = HandEyeFit(np.eye(4), np.eye(6), 1.0, (), 1.0)
START = CoarseHandEye(np.eye(4), 1.0, "stated", ())


@pytest.mark.slow
@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_hand_eye_error_is_what_the_covariance_predicts(mount):
    """From 5° and 30 mm, 4 draws of scatter and noise a mount: the error at the part is no larger than predicted.

    It may be smaller: these arms are perfect but for their scatter, and the views do not say so. Of what the scatter alone
    predicts it may not be half.
    """
    errors, predicted, alone, z = [], [], [], []
    for seed in range(4):
        measured, capture = captured_blade(seed, mount=mount, pixels=90, plan_seed=5)
        start, own = disturbed(measured.T_mount, seed), measurement_of(session_of(measured), capture)

        def erring(freed, T_mount, own=own):
            return prior_pose_errors([own], Model(T_mount), [f.overlaps.gram.centre for f in freed])

        gate = 0.35 * part_size([capture])
        found = correct([capture], start, gate, pose_error_prior=erring).hand_eye
        xi = frames.log(frames.inverse(measured.T_mount) @ found.T_mount)
        _, J = at_part(capture, found.T_mount)
        errors.append(np.sum((J @ xi) ** 2))
        predicted.append(np.trace(J @ found.covariance @ J.T))
        alone.append(np.trace(J @ correct([capture], start, gate).hand_eye.covariance @ J.T))
        z.append(xi / np.sqrt(np.diag(found.covariance)))
    assert np.sqrt(np.mean(errors) / np.mean(predicted)) < 1.2
    assert np.sqrt(np.mean(errors) / np.mean(alone)) > 0.5
    assert np.sqrt(np.mean(np.square(z))) < 1.3


def test_perfect_poses_leave_the_noise_that_was_put_in():
    measured, capture = captured_blade(2, repeatability=(0.0, 0.0))
    found = correct([capture], disturbed(measured.T_mount, 2, 0.5, 3.0), 10.0)
    truth = collect_overlaps(
        capture,
        capture.poses(measured.T_mount),
        found.overlaps[0].gate,
        [sample_points(s, 3000) for s in capture.scans],
    )
    assert found.overlaps[0].gram.rms == pytest.approx(truth.gram.rms, rel=0.03)


@pytest.mark.slow
def test_several_captures_share_one_hand_eye():
    """Two sessions of one rig know the hand-eye better than either."""
    cells = [captured_blade(seed, views=8, spread=(0.0, 0.0)) for seed in (3, 4)]
    captures = [capture for _, capture in cells]
    start = disturbed(cells[0][0].T_mount, 1, 2.0, 10.0)
    both = correct(captures, start, 15.0).hand_eye
    single = [correct([capture], start, 15.0).hand_eye for capture in captures]
    assert np.trace(both.covariance[3:, 3:]) < min(np.trace(s.covariance[3:, 3:]) for s in single) * 1.1
    xi = frames.log(frames.inverse(cells[0][0].T_mount) @ both.T_mount)
    assert xi @ np.linalg.solve(both.covariance, xi) < 25.0  # χ² with 6 degrees: 1 in 3,000


def test_no_overlap_is_a_result_with_a_reason():
    measured, capture = captured_blade(0, views=4)
    with pytest.raises(NoResultError, match="overlap"):
        correct([capture], measured.T_mount @ frames.exp(np.array([2.0, 0, 0, 0, 0, 4000.0])), 0.5)


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
