"""Hand-eye and landmarks from labelled points or a probe, against the truth and scipy's least squares."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from data_synth.fixtures.labelled_arm import PROBE_TURN, TARGETS, Growth, flange, labelled_cell, random_pose
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import run
from stitch.output.json_file import to_json
from stitch.output.result_document import model_of, result_document
from stitch.session.reading.session_folder import load_session


def off(T, true):
    """Angle (rad) and distance between two poses."""
    return np.linalg.norm(Rotation.from_matrix(T[:3, :3].T @ true[:3, :3]).as_rotvec()), np.linalg.norm(
        T[:3, 3] - true[:3, 3]
    )


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_hand_eye_and_targets_with_their_sigmas(mount):
    z = []
    for seed in range(6):
        session, T_mount, places = labelled_cell(seed, mount=mount)
        found = run(session)
        relative = np.linalg.inv(found.T_mount) @ T_mount
        xi = np.append(Rotation.from_matrix(relative[:3, :3]).as_rotvec(), relative[:3, 3])
        z.append(xi @ np.linalg.solve(found.mount_covariance, xi))
        assert np.abs(found.fused.points - places).max() < 0.1
        assert found.heldout_rms > found.residual_rms
    # Six χ² of six degrees of freedom; wider sigmas are allowed, too narrow ones are not.
    assert np.sum(z) < 67.99  # 99.9 % point of χ² with 36


@pytest.mark.slow
def test_targets_that_a_model_does_not_know_have_sigmas_of_their_own():
    """The model's hand-eye is used as it is: its error, the scatter and the noise are what moves a new target."""
    spread, squares = np.diag([1e-5] * 3 + [0.02] * 3), []
    for seed in range(8):
        session, T_mount, places = labelled_cell(seed, views=25)
        xi = spread @ np.random.default_rng([seed, 1]).normal(size=6)
        wrong = T_mount @ np.block([[Rotation.from_rotvec(xi[:3]).as_matrix(), xi[3:, None]], [np.eye(4)[3:]]])
        model = replace(model_of(run(session)), T_mount=wrong, covariance=spread**2, targets={})
        found = run(session, model)
        error = (found.fused.points - places).ravel()
        covariance = found.targets.landmarks_covariance[: error.size, : error.size]
        squares.append(error @ np.linalg.solve(covariance, error))
    assert chi2.ppf(0.001, error.size * len(squares)) < np.sum(squares) < chi2.ppf(0.999, error.size * len(squares))


def test_fit_equals_scipy_least_squares_where_all_rows_weigh_alike():
    session, *_ = labelled_cell(3, views=25, scatter=(0.0, 0.0))
    found = run(session)
    p = np.array([v.sighting.points for v in session.views])
    left = np.array([np.linalg.inv(v.T_base_flange) for v in session.views])

    def residual(x):
        placed = p @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:6]
        placed = np.einsum("vij,vkj->vki", left[:, :3, :3], placed) + left[:, None, :3, 3]
        return (placed - x[6:].reshape(-1, 3)).ravel()

    start = np.concatenate(
        [Rotation.from_matrix(found.T_mount[:3, :3]).as_rotvec(), found.T_mount[:3, 3], TARGETS.ravel()]
    )
    x = least_squares(residual, start + 1e-3, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    np.testing.assert_allclose(found.fused.points.ravel(), x[6:], atol=2e-4)
    assert found.residual_rms == pytest.approx(np.sqrt(np.mean(residual(x) ** 2) * 3), rel=1e-3)


def test_a_swapped_label_and_a_broken_joint_reading_are_taken_out_and_listed():
    session, T_mount, *_ = labelled_cell(4, views=40)
    views = list(session.views)
    s = views[7].sighting
    views[7] = replace(views[7], sighting=replace(s, points=s.points[[1, 0, 2, 3]]))
    views[20] = replace(views[20], joints=views[20].joints + 0.01, T_base_flange=flange(views[20].joints + 0.01))
    found = run(replace(session, views=tuple(views)))
    assert {o.view for o in found.outliers} == {7, 20}
    assert not any(o.view == 7 and o.target in ("t2", "t3") for o in found.outliers)
    angle, distance = off(found.T_mount, T_mount)
    assert angle < 1e-4 and distance < 0.3
    assert any("v7" in note and "v20" in note for note in found.notes)


def test_a_probe_is_placed_and_turned():
    session, T_mount, places = labelled_cell(6, views=60, probe=True)
    found = run(session)
    assert np.abs(found.fused.points[0] - places[0]).max() < 0.1
    assert Rotation.from_matrix(found.targets.landmarks.orientation.T @ PROBE_TURN).magnitude() < 1e-4


def test_nominal_targets_pull_by_their_sigma(tmp_path):
    session, _, places = labelled_cell(8, views=6, noise=0.05)
    folder = write_labelled(tmp_path / "s", session)
    T = random_pose(np.random.default_rng(1), 100)
    drawn = (places - T[:3, 3]) @ T[:3, :3]
    lines = [f"t{i},{p[0]:.6f},{p[1]:.6f},{p[2]:.6f},0.0001" for i, p in enumerate(drawn)]
    alone = run(load_session(folder)).fused.points
    (folder / "targets.csv").write_text("\n".join(["target,x,y,z,sigma", *lines]) + "\n")
    found = run(load_session(folder)).fused.points

    def shape(points):
        return np.linalg.norm(points[:, None] - points[None], axis=2)

    assert np.abs(shape(found) - shape(places)).max() < 1e-3
    assert np.abs(shape(alone) - shape(places)).max() > 1e-2


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_a_view_that_shows_nothing_only_says_where_the_arm_was(mount):
    session, T_mount, *_ = labelled_cell(6, mount=mount, grown=Growth(0.0, 0.0))
    blank = replace(session, views=tuple(replace(v, sighting=None) if k in (0, 7) else v
                                         for k, v in enumerate(session.views)))  # fmt: skip
    angle, distance = off(run(blank).T_mount, T_mount)
    assert angle < 1e-3 and distance < 1.0


def test_a_view_that_shows_nothing_has_no_rms():
    """Null in result.json, as FORMAT.md has it; a zero would be a perfect view."""
    session, *_ = labelled_cell(4, views=12)
    session = replace(session, views=(*session.views[:-1], replace(session.views[-1], sighting=None)))
    found = run(session)
    assert np.isfinite(found.view_rms[:-1]).all() and np.isnan(found.view_rms[-1])
    rows = json.loads(to_json(result_document(found)))["views"]
    assert rows[-1]["rms"] is None and rows[-1]["points"] == 0 and rows[0]["rms"] > 0


def test_real_tracker_on_even_poses_judges_the_odd_ones(shared_data):
    session = load_session(shared_data / "irb120-tracker")
    even, odd = (replace(session, views=session.views[k::2]) for k in (0, 1))
    fitted = run(even)
    assert 0.90 < run(odd, model_of(fitted)).residual_rms < 0.97
