"""The first hand-eye from labelled points, where the flange stands at one place and only turns."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.real_arms import THREE_SIGMA, turning, turning_session
from data_synth.fixtures.labelled_arm import labelled_cell
from stitch import NoResultError
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.session.capture import prepare_capture


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("within", [0, 1, 50])
@pytest.mark.parametrize("targets", [3, 10])
def test_a_flange_that_only_turns_shows_the_hand_eye_within_its_sigmas(targets, within, mount):
    row = turning({"seed": 1, "targets": targets, "within": within, "mount": mount})
    assert row["ended"] == "" and row["sigmas2"] < THREE_SIGMA


def test_a_board_of_88_points_shows_it_too_within_seconds():
    session, X = turning_session({"seed": 1, "targets": 88, "within": 0, "mount": "eye_in_hand"})
    off = np.linalg.inv(closed_form_hand_eye(prepare_capture(session))) @ X
    assert np.linalg.norm(Rotation.from_matrix(off[:3, :3]).as_rotvec()) < 1e-3 and np.linalg.norm(off[:3, 3]) < 0.2


def test_a_wrong_label_in_every_fifth_view_does_not_pull():
    session, T_mount, _ = labelled_cell(2, views=20)
    views = [
        replace(v, sighting=replace(v.sighting, points=v.sighting.points[[1, 0, 2, 3]])) if i % 5 == 0 else v
        for i, v in enumerate(session.views)
    ]
    T = closed_form_hand_eye(prepare_capture(replace(session, views=tuple(views))))
    off = np.linalg.inv(T) @ T_mount
    assert np.linalg.norm(Rotation.from_matrix(off[:3, :3]).as_rotvec()) < 2e-4 and np.linalg.norm(off[:3, 3]) < 0.3


def test_three_views_of_one_target_do_not_show_it():
    session, *_ = labelled_cell(2, views=3, targets=np.array([[60.0, 10.0, 30.0]]))
    with pytest.raises(NoResultError, match="do not show the hand-eye"):
        closed_form_hand_eye(prepare_capture(session))
