"""Hand-eye, landmarks and effects from labelled points, against the truth and scipy's least squares; of one session and of several."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from data_synth.fixtures.labelled_arm import PROBE_TURN, TARGETS, flange, labelled_cell, random_pose
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import diagnose, run, run_rig
from stitch.effects.contract import EFFECTS
from stitch.errors import InputError
from stitch.fit.target_fit import LinearisedTargets, TargetSession
from stitch.model.forward import corrected_capture
from stitch.model.model import Model, term_of
from stitch.numerics import frames
from stitch.observations.targets.rows import initial_landmarks
from stitch.output.json_file import to_json
from stitch.output.result_document import model_of, result_document
from stitch.session.reading.session_folder import load_session
from tests.command_line import ended

OFFSET = np.array([0, 1e-3, -0.7e-3, 0, 0.8e-3, 0])


def named(session, name):
    return replace(session, name=name, path=session.path / name)


@pytest.fixture(scope="module")
def days():
    """Two days: the sensor elsewhere, other poses, three targets and then one."""
    found = [
        labelled_cell(20, views=30, offset=OFFSET),
        labelled_cell(21, views=26, offset=OFFSET, targets=TARGETS[:1]),
    ]
    return [named(session, f"day {k}") for k, (session, *_) in enumerate(found)], [T for _, T, _ in found]


def off(T, true):
    """Angle (rad) and distance between two poses."""
    return np.linalg.norm(Rotation.from_matrix(T[:3, :3].T @ true[:3, :3]).as_rotvec()), np.linalg.norm(
        T[:3, 3] - true[:3, 3]
    )


@pytest.mark.parametrize("mount", ["eye_to_hand", pytest.param("eye_in_hand", marks=pytest.mark.slow)])
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
    session, T_mount, *_ = labelled_cell(6, mount=mount, grown=(0.0, 0.0))
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


def test_sessions_share_the_arm_and_each_has_its_own_hand_eye(days):
    sessions, true = days
    runs = run_rig(sessions, effects=["joint_offset"])
    values = [[p.value for term in r.terms for p in term.parameters] for r in runs]
    assert values[0] == values[1]
    for r, T in zip(runs, true, strict=True):
        off = frames.log(frames.inverse(T) @ r.T_mount)
        sigma = np.sqrt(np.diag(r.mount_covariance))
        assert np.abs(off / sigma).max() < 4
        assert r.residual_rms < 0.5 * run(r.session).residual_rms
    sigmas = [p.sigma for term in runs[0].terms for p in term.parameters]
    off, joints = np.array(values[0]) - OFFSET, [1, 2, 4]
    assert np.all(np.abs(off[joints]) < 4 * np.array(sigmas)[joints])


def test_what_two_sessions_say_of_the_arm_adds_up(days):
    """Against the two alone: their estimates weighed by their own covariances (independent sessions)."""
    sessions, _ = days
    both = run_rig(sessions, effects=["joint_offset"])[0].terms[0]
    information, vector = np.zeros((3, 3)), np.zeros(3)
    joints = [1, 2, 4]
    for session in sessions:
        alone = run(session, effects=["joint_offset"])
        matrix = dict(zip(alone.model.effects_covariance.names, np.arange(9), strict=False))
        own = [matrix[f"joint_offset.d{j + 1}"] for j in joints]
        C = alone.model.effects_covariance.matrix[np.ix_(own, own)] / alone.targets.inflation
        information += np.linalg.inv(C)
        vector += np.linalg.solve(C, alone.terms[0].values[joints])
    expected, sigma = np.linalg.solve(information, vector), np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.abs(both.values[joints] - expected).max() < 0.5 * sigma.max()


def test_three_loads_share_one_compliance():
    """Each kilogram bends joint 2 by the same: one number explains all, where each load alone says little."""
    sag, loads = 4e-7, (1.0, 4.0, 8.0)
    sessions = [
        named(labelled_cell(30 + k, views=24, sag=sag, payload=np.full(24, kg))[0], f"load {k}")
        for k, kg in enumerate(loads)
    ]
    plain, bent = run_rig(sessions), run_rig(sessions, effects=["joint_compliance"])
    for before, after in zip(plain[1:], bent[1:], strict=True):
        assert after.heldout_rms < 0.7 * before.heldout_rms
    assert bent[2].residual_rms < 1.3 * bent[0].residual_rms


def test_other_arms_and_other_kinds_are_refused(days):
    sessions, _ = days
    other = replace(sessions[1], robot=replace(sessions[1].robot, theta=sessions[1].robot.theta + 1e-3))
    with pytest.raises(InputError, match="another arm"):
        run_rig([sessions[0], other])


def test_the_command_writes_a_folder_a_session_and_an_arm_to_keep(days, tmp_path):
    sessions, _ = days
    folders = [write_labelled(tmp_path / name, s) for name, s in zip(("one", "two"), sessions, strict=True)]
    out = tmp_path / "both"
    told = ended("run", *folders, "-o", out, "--effects", "joint_offset", "--no-recording", "--json")
    documents = json.loads(told.out)
    assert documents[0]["effects"] == documents[1]["effects"]
    assert documents[0]["hand_eye"] != documents[1]["hand_eye"]
    third = write_labelled(tmp_path / "three", labelled_cell(22, views=24, offset=OFFSET)[0])
    told = ended("run", third, "-o", tmp_path / "r", "--arm", out, "--no-recording", "--json")
    kept = json.loads(told.out)
    assert kept["residual_rms"] < 0.5 * run(labelled_cell(22, views=24, offset=OFFSET)[0]).residual_rms


def test_a_parameter_that_goes_to_zero_is_made_up_for_in_the_same_step():
    """From a model with an offset that is no longer fitted, the step ends where it ends from a model without it."""
    session, *_ = labelled_cell(5, views=30)
    found = run(session)
    ends = []
    for value in (0.0, 1e-5):
        term = term_of(found.measurement, EFFECTS["joint_offset"])
        model = Model(found.model.T_mount, (term.at(np.array([0, value, 0, 0, 0, 0])),))
        landmarks = initial_landmarks(corrected_capture(found.measurement, model), model.T_mount)
        begun = TargetSession(found.measurement, model, landmarks)
        step = LinearisedTargets([begun], None).solve(np.zeros(6, bool))
        assert not step.model.terms[0].values.any()
        ends.append(step.model.T_mount)
    moved_by_it = 1e-5 * 1000
    assert np.abs(ends[0] - ends[1]).max() < 1e-2 * moved_by_it


def test_a_view_whose_sightings_are_all_out_leaves_the_terminal_empty(capfd):
    """Its block has no size, of which LAPACK complained on file descriptor 2."""
    session, *_ = labelled_cell(3, views=90)
    far = session.views[5].sighting
    off = 8 * np.random.default_rng(0).normal(size=far.points.shape)
    views = list(session.views)
    views[5] = replace(views[5], sighting=replace(far, points=far.points + off))
    fit = run(replace(session, views=tuple(views)))
    assert not fit.measurement.capture.sightings.used[5].any()
    assert diagnose(fit).sentence
    assert capfd.readouterr() == ("", "")
