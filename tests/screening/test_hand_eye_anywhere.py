"""U of the hand-eye with what the views cannot show, against a fit of hand-eye and all these effects together."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured, measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.model.model import Model
from stitch.observations.surfaces.hand_eye_fit import Repeatability, pose_covariance
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.screening.hand_eye_anywhere import hand_eye_sigma_anywhere
from stitch.screening.view_model import UsualEffects, thin_correspondences, view_model
from stitch.session.measurement import measurement_of, with_part_origin

SCATTER = Repeatability(2e-5, 0.02, 1.0)


@pytest.fixture(scope="module")
def cell():
    """What the views of a cell show, its hand-eye as well known as its scatter lets it, and effects that it may have."""
    measured = measured_blade(22, views=8, pixels=70)
    capture = captured(measured)
    measurement = with_part_origin(measurement_of(session_of(measured), capture), measured.T_mount)
    views = unconstrained_poses(capture, capture.poses(measured.T_mount), 4 * capture.spacing)
    reduced = view_model(capture, measured.T_mount, views).reduced
    C = pose_covariance(reduced, SCATTER)
    model = Model(measured.T_mount)
    known = np.linalg.inv(reduced.hand_eye.T @ np.linalg.solve(C, reduced.hand_eye))
    model = replace(model, covariance=known)
    usual = UsualEffects(measurement, model).by_place(thin_correspondences(views))
    J = reduced.reduction @ np.hstack([columns for place, columns in usual.items() if place not in ("robot", "links")])
    return measurement, model, views, reduced.hand_eye, C, J


def test_it_is_that_of_a_fit_of_all_effects_in_their_usual_sizes(cell):
    measurement, model, views, A, C, J = cell
    columns = np.hstack([A, J])
    prior = np.diag([0.0] * 6 + [1.0] * J.shape[1])
    together = np.linalg.inv(columns.T @ np.linalg.solve(C, columns) + prior)
    sigma = hand_eye_sigma_anywhere(measurement, model, views, SCATTER)
    assert sigma == pytest.approx(np.sqrt(np.diag(together))[:6], rel=1e-5)
    assert (sigma > np.sqrt(np.diag(model.covariance))).all()


def test_an_effect_drawn_in_its_usual_size_moves_the_hand_eye_by_no_more_than_it_says(cell):
    """Draws of what no view shows: of the effects, the part that is left once their visible part is known."""
    measurement, model, views, A, C, J = cell
    rng = np.random.default_rng(0)
    both = np.hstack([A, J])
    normal = both.T @ np.linalg.solve(C, both) + np.diag([0.0] * 6 + [1.0] * J.shape[1])
    errors = []
    for _ in range(400):
        effects = rng.standard_normal(J.shape[1])
        z = J @ effects + np.linalg.cholesky(C) @ rng.standard_normal(len(C))
        errors.append(np.linalg.solve(normal, both.T @ np.linalg.solve(C, z))[:6])
    sigma = hand_eye_sigma_anywhere(measurement, model, views, SCATTER)
    # The scatter of 400 draws is known to 4 %.
    assert np.abs(np.std(errors, axis=0) / sigma - 1).max() < 0.15
