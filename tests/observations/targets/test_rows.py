"""Closed form of the hand-eye and rows of labelled points, against a cell written down apart from the library.

The first hand-eye from labelled points, where the flange stands at one place and only turns.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch import NoResultError, run
from stitch.effects.contract import EFFECTS, missing_need
from stitch.model.forward import PointSlopes, corrected_capture, target_correction
from stitch.model.model import Model, term_of
from stitch.numerics import frames
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.observations.targets.rows import initial_landmarks, target_rows
from stitch.observations.targets.target_model import target_model
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from tests.observations.honest_arms import turning_session


def off(T, true):
    """Angle (rad) and distance between two poses."""
    return np.linalg.norm(Rotation.from_matrix(T[:3, :3].T @ true[:3, :3]).as_rotvec()), np.linalg.norm(
        T[:3, 3] - true[:3, 3]
    )


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_closed_form_is_exact_without_errors(mount):
    session, T_mount, *_ = labelled_cell(mount=mount, scatter=(0, 0), noise=1e-12)
    angle, distance = off(closed_form_hand_eye(prepare_capture(session)), T_mount)
    assert angle < 1e-9 and distance < 1e-6


def test_closed_form_of_a_probe_is_exact_without_errors():
    session, T_mount, *_ = labelled_cell(scatter=(0, 0), noise=1e-12, probe=True)
    views = [replace(v, sighting=replace(v.sighting, rotation=np.linalg.inv(T_mount)[:3, :3] @ v.T_base_flange[:3, :3]))
             for v in session.views]  # fmt: skip
    angle, distance = off(closed_form_hand_eye(prepare_capture(replace(session, views=tuple(views)))), T_mount)
    assert angle < 1e-9 and distance < 1e-6


def test_rows_are_the_slopes_of_what_is_left():
    session, T_mount, *_ = labelled_cell(1, views=6, scatter=(0, 0), noise=1e-9)
    measurement = measurement_of(session, prepare_capture(session))
    for name in ("joint_offset", "link_geometry", "joint_compliance", "range_scale", "fixture_drift"):
        effect = EFFECTS[name]
        if missing_need(measurement, effect):
            continue
        zero, plain = term_of(measurement, effect), Model(T_mount)
        landmarks = initial_landmarks(measurement.capture, T_mount)
        rows = target_rows(measurement.capture, T_mount, landmarks)
        (slopes,) = rows.effect_columns(measurement, plain, [zero])
        for i, parameter in enumerate(zero.parameters):
            step = 0.01 * parameter.typical
            stepped = [zero.at(s * step * np.eye(len(zero.values))[i]) for s in (1, -1)]
            captures = [corrected_capture(measurement, plain.with_term(term)) for term in stepped]
            both = [target_rows(own, T_mount, landmarks).residual for own in captures]
            numeric = (both[0] - both[1]) / (2 * step)
            scale = max(np.abs(numeric).max(), 1e-12)
            np.testing.assert_allclose(
                slopes[..., i] / scale, numeric / scale, atol=2e-4, err_msg=f"{name} {parameter.name}"
            )


def test_a_turn_of_the_flange_is_exactly_a_turn_of_the_targets():
    # The last joint's offset must not borrow from what is left, however large that is.
    session, T_mount, *_ = labelled_cell(1, views=12, scatter=(1e-3, 1.0))
    measurement = measurement_of(session, prepare_capture(session))
    term = term_of(measurement, EFFECTS["joint_offset"])
    rows = target_rows(measurement.capture, T_mount, initial_landmarks(measurement.capture, T_mount))
    column = rows.effect_columns(measurement, Model(T_mount), [term])[0][..., 5].ravel()
    landmarks = rows.landmarks.reshape(rows.residual.size, -1)
    left = column - landmarks @ np.linalg.lstsq(landmarks, column, rcond=None)[0]
    assert np.abs(left).max() < 1e-6 * np.abs(column).max()


def test_slopes_of_shifts_are_linear_in_small_steps():
    session, T_mount, *_ = labelled_cell(1, views=4)
    measurement = measurement_of(session, prepare_capture(session))
    term = term_of(measurement, EFFECTS["range_scale"])
    poses = measurement.capture.poses(T_mount)
    moved = target_correction(measurement, [term.at([1e-6])], poses)
    np.testing.assert_allclose(
        moved, 1e-6 * PointSlopes(measurement, [term], Model(T_mount)).at_targets(poses)[0], rtol=1e-3
    )


def test_effects_of_points_act_where_the_targets_lie_and_not_where_an_error_puts_them():
    # A ball on the flange, half a millimetre off in every view: its error must not be part of any effect's column.
    session, T_mount, _ = labelled_cell(1, views=12, scatter=(1e-3, 0.5), targets=np.array([[0.0, 0.0, 120.0]]))
    measurement = measurement_of(session, prepare_capture(session))
    capture = measurement.capture
    rows = target_rows(capture, T_mount, initial_landmarks(capture, T_mount))
    poses = capture.poses(T_mount)
    place = np.mean([T[:3, :3] @ p[0] + T[:3, 3] for T, p in zip(poses, capture.sightings.points, strict=True)], axis=0)
    down = np.array([T[:3, :3].T @ [0, 0, -1.0] for T in measurement.T_base_flange])
    for name, expected in (("range_scale", poses[:, :3, 3] - place), ("part_sag", -(place[2] ** 2) * down)):
        (column,) = rows.effect_columns(measurement, Model(T_mount), [term_of(measurement, EFFECTS[name])])
        np.testing.assert_allclose(column[..., 0], expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("within", [0, 1, 50])
@pytest.mark.parametrize("targets", [3, 10])
def test_a_flange_that_only_turns_shows_the_hand_eye_within_its_sigmas(targets, within, mount):
    session, X = turning_session(targets, within, mount)
    fit = run(session)
    twist = frames.log(frames.inverse(fit.T_mount) @ X)
    assert twist @ np.linalg.solve(fit.hand_eye.covariance, twist) < chi2.ppf(0.9973, 6)


def test_a_board_of_88_points_shows_it_too_within_seconds():
    session, X = turning_session(88, 0, "eye_in_hand")
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


def test_what_left_out_views_show_counts_as_many_squares_as_numbers_in_units_of_their_scatter():
    session, T_mount, *_ = labelled_cell(5, views=80)
    linear = target_model(measurement_of(session, prepare_capture(session)), Model(T_mount), None)
    trial = linear.baseline_trial
    squares = trial.scatter(np.arange(80), trial.solve())
    rows = linear.observation.rows
    numbers = rows.used.sum()
    assert chi2.ppf(1e-4, numbers - 6 - rows.landmarks.shape[2]) < squares < chi2.ppf(1 - 1e-4, numbers)
