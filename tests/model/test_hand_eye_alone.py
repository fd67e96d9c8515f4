"""The hand-eye without its model: at the mean of the effects over the views, with what single views differ by."""

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import flange, joints_of, labelled_cell
from stitch.api.pipeline import run
from stitch.model.hand_eye_alone import hand_eye_alone
from stitch.numerics import frames

SHIFT = np.array([0, 0, 0, 2.0, -1.0, 0.5])


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_without_effects_of_base_arm_or_mount_there_is_no_other(mount):
    fitted = run(labelled_cell(3, 20, mount)[0], effects=["part_slip"])
    assert hand_eye_alone(fitted.measurement, fitted.model) is None


def test_a_bracket_that_droops_alike_in_all_views_is_in_the_hand_eye():
    """The mean twist of the views, written out: g less z of each, times what the bracket gives way by."""
    joints = joints_of(np.random.default_rng(5), 30)
    turned = np.array([flange(q)[:3, :3].T @ [0, 0, -1.0] for q in joints]) - [0, 0, 1.0]
    lever, sideways = np.array([2e-3, -3e-3, 4e-3]), 1.5
    moved = np.hstack([np.cross(lever, turned), sideways * turned * [1, 1, 0]])
    session, T_mount, _ = labelled_cell(5, 30, "eye_in_hand", errors=(np.zeros((30, 6)), moved))
    with_it = run(session, effects=["mount_droop"])
    alone = hand_eye_alone(with_it.measurement, with_it.model)
    expected = frames.exp(moved.mean(axis=0)) @ T_mount
    middle = np.mean([view.sighting.points.mean(axis=0) for view in session.views], axis=0)[None]

    def apart(T, other):
        return float(np.linalg.norm(frames.transform(T, middle) - frames.transform(other, middle)))

    assert apart(with_it.T_mount, expected) > 0.2
    assert apart(alone.T_mount, expected) < 0.15 * apart(with_it.T_mount, expected)
    assert alone.displacement == pytest.approx(apart(alone.T_mount, with_it.T_mount), rel=1e-6)
    spread = [apart(frames.exp(twist) @ T_mount, expected) for twist in moved]
    assert alone.spread == pytest.approx(np.sqrt(np.mean(np.square(spread))), rel=0.2)
    # Its U is no smaller than what single views differ by.
    lever = np.hstack([-frames.skew(middle[0]), np.eye(3)])
    assert np.trace(lever @ alone.covariance @ lever.T) >= alone.spread**2


def test_a_step_of_the_mount_counts_as_it_ended():
    session, *_ = labelled_cell(6, 24)
    fitted = run(session, effects=["mount_step"])
    (step,) = fitted.terms
    values = np.where([p.discrete for p in step.parameters], 12.0, np.append(SHIFT, 0.0))
    model = fitted.model.with_terms([step.at(values)])
    alone = hand_eye_alone(fitted.measurement, model)
    np.testing.assert_allclose(alone.T_mount, fitted.T_mount @ frames.exp(SHIFT), atol=1e-9)
    assert alone.spread == pytest.approx(0.0, abs=1e-9)
