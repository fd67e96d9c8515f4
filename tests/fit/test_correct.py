"""The corrected hand-eye on scans of cells of known truth."""

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured_blade, disturbed
from data_synth.fixtures.in_memory import session_of
from stitch.errors import NoResultError
from stitch.fit.correct import correct
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.observations.pose_errors import prior_pose_errors
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.session.capture import part_size
from stitch.session.measurement import measurement_of
from tests.fit.at_part import at_part


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
