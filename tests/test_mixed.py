"""Clouds and labelled points in one session: each weighs by its own sigma, judged by the truth of simulated cells."""

import json
from dataclasses import replace

import numpy as np
import pytest
from in_memory import session_of
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from synthetic_cells import simulated

from data_synth.scene import load_scene
from data_synth.write import write_session
from stitch import frames
from stitch.cli.main import main
from stitch.effects.contract import EFFECTS
from stitch.measurement.capture import capture
from stitch.measurement.labelled_points import Sighting
from stitch.measurement.measurement import Term, measurement_of
from stitch.measurement.sightings import Sightings
from stitch.model.forward import corrected
from stitch.observations.surfaces.free_poses import answer, free_poses
from stitch.observations.surfaces.gram import Gram, assemble
from stitch.observations.surfaces.point_effects import point_gram
from stitch.observations.surfaces.target_pairs import joined, target_pairs
from stitch.pipeline import run

VIEWS = 12


def plate(seed, hidden=None, sigma=0.015, noise=0.02, views=VIEWS, rays=50):
    """What the cell with the drilled plate measured, with few rays."""
    scene = load_scene("drill-plate")
    scene = replace(
        scene,
        scanner=replace(scene.scanner, columns=rays, rows=rays, noise=noise),
        part=replace(scene.part, sigma=sigma),
    )
    return simulated(scene, hidden or {}, seed, views)


def mixed(measured, stated=None):
    """The session with its labelled points, and the sigma that they state."""
    stated = measured.scene.part.sigma if stated is None else stated
    session = session_of(measured)
    names = np.array(list(measured.labelled))
    places = np.array([measured.labelled[name] for name in names])  # (K, V, 3)
    views = []
    for v, view in enumerate(session.views):
        seen = np.isfinite(places[:, v, 0])
        sighting = Sighting(tuple(names[seen]), places[seen, v], np.full(seen.sum(), stated))
        views.append(replace(view, sighting=sighting if seen.any() else None))
    return replace(session, views=tuple(views))


def clouds_of(session):
    return replace(session, views=tuple(replace(view, sighting=None) for view in session.views))


def points_of(session):
    return replace(session, views=tuple(replace(view, cloud=None) for view in session.views))


def error(T, true):
    """(6,) rotation vector and translation from T to the truth, scanner frame."""
    D = np.linalg.inv(T) @ true
    return np.concatenate([Rotation.from_matrix(D[:3, :3]).as_rotvec(), D[:3, 3]])


def in_sigmas(e, covariance):
    return float(e @ np.linalg.solve(covariance, e))


def far(runs, truths):
    """Rms distance of hand-eyes from the truth."""
    return np.sqrt(
        np.mean([error(r.T_mount, T)[3:] @ error(r.T_mount, T)[3:] for r, T in zip(runs, truths, strict=True)])
    )


def scattered(seed, views=7, targets=4):
    """Sightings of points that some views do not show, with sigmas of their own, and poses that are off."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3, :3] = Rotation.random(views, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(views, 3)) * 300
    places = rng.normal(size=(targets, 3)) * 80
    order = np.array([rng.permutation(targets) for _ in range(views)])
    points = frames.transform(frames.inverse(poses), places[order]) + 0.1 * rng.normal(size=(views, targets, 3))
    used = rng.random(order.shape) < 0.8
    sigma = rng.uniform(0.01, 0.1, order.shape)
    return Sightings(tuple("abcd"), np.where(used, order, -1), points, sigma, used), poses


def no_surface(views, centre, variance=1.0):
    """A Gram of one pair of surfaces that know nothing, with a variance."""
    one = np.ones(1)
    return Gram(views, np.array([[0, 1]]), np.zeros((1, 6, 6)), np.zeros((1, 6)), variance * one, one, one,
                variance * one, np.sqrt(variance), centre, np.zeros(1, bool))  # fmt: skip


def dense(sightings, poses, centre):
    """Normal matrix and vector of twists (6V) and places (3K), one row a coordinate, written out."""
    V, K = len(poses), len(sightings.targets)
    rows, left = [], []
    placed = {
        (v, s): poses[v, :3, :3] @ sightings.points[v, s] + poses[v, :3, 3] for v, s in np.argwhere(sightings.used)
    }
    for k in range(K):
        own = [(v, s) for v, s in placed if sightings.target[v, s] == k]
        weights = np.array([sightings.sigma[v, s] ** -2.0 for v, s in own])
        mean = np.sum([w * placed[o] for w, o in zip(weights, own, strict=True)], axis=0) / weights.sum()
        for v, s in own:
            row = np.zeros((3, 6 * V + 3 * K))
            m = mean - centre
            row[:, 6 * v : 6 * v + 3] = -np.array([[0, -m[2], m[1]], [m[2], 0, -m[0]], [-m[1], m[0], 0]])
            row[:, 6 * v + 3 : 6 * v + 6] = np.eye(3)
            row[:, 6 * V + 3 * k : 6 * V + 3 * k + 3] = -np.eye(3)
            rows.append(row / sightings.sigma[v, s])
            left.append((placed[v, s] - mean) / sightings.sigma[v, s])
    A, e = np.concatenate(rows), np.concatenate(left)
    return A, e


@pytest.mark.parametrize("seed", range(3))
def test_pairs_are_the_dense_least_squares_with_the_places_eliminated(seed):
    sightings, poses = scattered(seed)
    centre, n = np.array([5.0, -3.0, 8.0]), 6 * len(poses)
    A, e = dense(sightings, poses, centre)
    N, b = A.T @ A, A.T @ e
    inverse = np.linalg.inv(N[n:, n:])
    H, vector = assemble(joined(no_surface(len(poses), centre), target_pairs(sightings, poses), 1.0))
    scale = np.abs(H).max()
    np.testing.assert_allclose(H / scale, (N[:n, :n] - N[:n, n:] @ inverse @ N[n:, :n]) / scale, atol=1e-12)
    np.testing.assert_allclose(vector, b[:n] - N[:n, n:] @ inverse @ b[n:], atol=1e-9 * np.abs(b).max())


def test_surfaces_of_huge_variance_leave_the_answer_of_the_targets():
    sightings, poses = scattered(3)
    centre = np.zeros(3)
    A, e = dense(sightings, poses, centre)
    x = np.linalg.lstsq(A, -e, rcond=1e-12)[0]
    g = no_surface(len(poses), centre, 1e8)
    rng = np.random.default_rng(0)
    lean = rng.normal(size=(1, 6, 6))
    surfaces = replace(g, matrix=lean @ lean.transpose(0, 2, 1), vector=1e4 * rng.normal(size=(1, 6)))
    g = joined(surfaces, target_pairs(sightings, poses), 1.0)
    step = -answer(g, g.vector[..., None])[:, 0]
    left = A[:, : 6 * len(poses)] @ step + e
    # The common motion is free: what is left of the targets is compared, their places settled anew.
    left -= A[:, 6 * len(poses) :] @ np.linalg.lstsq(A[:, 6 * len(poses) :], left, rcond=None)[0]
    np.testing.assert_allclose(left, A @ x + e, atol=1e-3 * np.abs(A @ x + e).max())


SEEDS = range(2)


@pytest.fixture(scope="module")
def cells():
    """Sessions of several seeds with their runs: clouds alone, points alone, both."""
    measured = [plate(seed) for seed in SEEDS]
    sessions = [mixed(m) for m in measured]
    return [m.T_mount for m in measured], sessions, {
        "clouds": [run(clouds_of(s)) for s in sessions],
        "points": [run(points_of(s)) for s in sessions],
        "both": [run(s) for s in sessions],
    }  # fmt: skip


def test_both_know_the_hand_eye_better_than_either_and_say_how_well(cells):
    truths, _, runs = cells
    assert far(runs["both"], truths) < min(far(runs["clouds"], truths), far(runs["points"], truths))
    z = [in_sigmas(error(r.T_mount, T), r.mount_covariance) for r, T in zip(runs["both"], truths, strict=True)]
    # χ² of six degrees of freedom a seed, between its 0.1 % and 99.9 % points.
    assert chi2.ppf(1e-3, 6 * len(z)) < sum(z) < chi2.ppf(0.999, 6 * len(z))


def test_targets_lie_where_they_are_within_their_sigma(cells):
    _, _, runs = cells
    for seed, found in zip(SEEDS, runs["both"], strict=True):
        true, covariance = plate(seed), found.labelled.landmarks_covariance
        z = []
        for k, name in enumerate(found.labelled.rows.capture.sightings.targets):
            d = found.labelled.landmarks.positions[k] - true.targets[name]
            z.append(in_sigmas(d, covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]))
        # The targets of one run share the error of its hand-eye: three degrees of freedom each, judged one by one.
        assert max(z) < chi2.ppf(1 - 1e-3 / len(z) / len(SEEDS), 3)


def test_points_of_huge_sigma_change_nothing(cells):
    _, sessions, runs = cells
    loose = replace(sessions[0], views=tuple(
        replace(v, sighting=v.sighting and replace(v.sighting, sigma=np.full(len(v.sighting.sigma), 1e6)))
        for v in sessions[0].views))  # fmt: skip
    found, alone = run(loose), runs["clouds"][0]
    assert in_sigmas(error(found.T_mount, alone.T_mount), alone.mount_covariance) < 1e-2


def test_clouds_of_huge_noise_leave_the_answer_of_the_points():
    session = mixed(plate(1, noise=2.0))
    found, alone = run(session), run(points_of(session))
    assert in_sigmas(error(found.T_mount, alone.T_mount), alone.mount_covariance) < chi2.ppf(0.999, 6)


def test_points_weigh_by_their_own_sigma():
    measured = [plate(seed, sigma=0.3) for seed in range(1)]
    truths = [m.T_mount for m in measured]
    honest, boasting = ([run(mixed(m, stated)) for m in measured] for stated in (0.3, 0.003))
    assert far(honest, truths) < far(boasting, truths)


def test_a_wrong_point_is_found_and_listed_and_pulls_nothing():
    session = mixed(plate(2))
    views = list(session.views)
    s = views[4].sighting
    wrong, right = s.points.copy(), np.arange(len(s.targets)) != 3
    wrong[3] += [0.6, -0.8, 0.3]
    views[4] = replace(views[4], sighting=replace(s, points=wrong))
    found = run(replace(session, views=tuple(views)))
    assert [(o.view, o.target) for o in found.outliers] == [(4, s.targets[3])]
    assert any(f"{s.targets[3]} in view v004" in note for note in found.notes)
    named = tuple(np.array(s.targets)[right])
    views[4] = replace(views[4], sighting=Sighting(named, s.points[right], s.sigma[right]))
    without = run(replace(session, views=tuple(views)))
    np.testing.assert_allclose(found.T_mount, without.T_mount, atol=1e-9)


def test_sums_of_targets_are_the_slopes_of_what_sets_them_apart():
    session = mixed(plate(0))
    measurement = measurement_of(session, capture(session))
    T_mount = plate(0).T_mount
    own = measurement.capture
    freed = free_poses(own, own.poses(T_mount), 2.0)
    term = Term(EFFECTS["range_scale"], np.zeros(1))
    sums, g = point_gram(measurement, (), [term], freed), freed.overlaps.gram
    step = 0.01 * measurement.parameters(term.effect)[0].typical
    pulls, squares = [], []
    for sign in (1, -1):
        moved = corrected(measurement, [replace(term, values=np.array([sign * step]))], T_mount)
        pairs = target_pairs(moved.sightings, freed.poses)
        both = joined(no_surface(VIEWS, g.centre, g.variance), pairs, 1.0)
        pulls.append(both.vector[both.labelled])
        squares.append(both.square[both.labelled])
    # Σ w e² changes by 2 Σ w g e.
    slopes = (pulls[0] - pulls[1]) / (2 * step), (squares[0] - squares[1]) / (4 * step)
    for slope, own_sums in zip(slopes, (sums.vector[..., 0], sums.residual[:, 0]), strict=True):
        np.testing.assert_allclose(slope, own_sums[g.labelled], atol=1e-3 * np.abs(own_sums[g.labelled]).max())


def test_a_sensor_effect_that_acts_on_both_is_found():
    measured = plate(3, hidden={"range_scale": 4.0})
    after = run(mixed(measured)).add("range_scale")
    value, sigma = after.terms[0].values[0], after.sigmas[0][0]
    # Normal errors stay within 3.3 sigmas in 999 of 1000 cases; the effect itself is larger.
    assert abs(value - measured.hidden["range_scale"]["s"]) < 3.3 * sigma < abs(value)


def test_every_command_works(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    measured = plate(5, views=10)
    write_session(tmp_path / "s", measured, "plate")
    out = str(tmp_path / "r")

    def stitch(*arguments):
        with pytest.raises(SystemExit) as stop:
            main(list(arguments))
        assert not stop.value.code, capsys.readouterr().err
        return capsys.readouterr().out

    first = json.loads(stitch("run", str(tmp_path / "s"), "-o", out, "--json"))
    assert {t["target"] for t in first["targets"]} == set(measured.targets)
    assert all(np.isfinite(t["sigma"]).all() for t in first["targets"]) and first["outliers"] == []
    assert json.loads(stitch("diagnose", out, "--json"))["effects"] is not None
    stitch("compare", out)
    second = json.loads(stitch("add", out, "joint_offset", "--no-recording", "--json"))
    assert "joint_offset" in second["effects"] and second["targets"]
    assert "Targets" in (tmp_path / "r" / "report.html").read_text()
    judged = json.loads(
        stitch("run", str(tmp_path / "s"), "--hand-eye", out, "-o", str(tmp_path / "q"), "--no-recording", "--json")
    )
    assert len(judged["targets"]) == len(first["targets"])
    page = tmp_path / "q" / "report.html"
    targets = [line for line in page.read_text().splitlines() if "reference frame</td>" in line]
    stitch("report", str(tmp_path / "q"), "--no-diagnosis")
    assert len(targets) == len(first["targets"]) and all(line in page.read_text() for line in targets)
