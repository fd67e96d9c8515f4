"""Sums of labelled points beside those of surfaces, against dense least squares."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.drilled_plate import VIEWS, measured_plate
from data_synth.fixtures.in_memory import labelled_session_of
from stitch.effects.contract import EFFECTS
from stitch.model.forward import target_correction
from stitch.model.model import Model, term_of
from stitch.numerics import frames
from stitch.observations.surfaces.effect_columns import view_responses
from stitch.observations.surfaces.normal_equations import Gram, append_targets, assemble, target_pairs
from stitch.observations.surfaces.view_poses import solve_views, unconstrained_poses
from stitch.session.capture import Sightings, prepare_capture
from stitch.session.measurement import measurement_of


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
    H, vector = assemble(append_targets(no_surface(len(poses), centre), target_pairs(sightings, poses), 1.0))
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
    g = append_targets(surfaces, target_pairs(sightings, poses), 1.0)
    step = -solve_views(g, g.vector[..., None])[:, 0]
    left = A[:, : 6 * len(poses)] @ step + e
    # The common motion is free: what is left of the targets is compared, their places settled anew.
    left -= A[:, 6 * len(poses) :] @ np.linalg.lstsq(A[:, 6 * len(poses) :], left, rcond=None)[0]
    np.testing.assert_allclose(left, A @ x + e, atol=1e-3 * np.abs(A @ x + e).max())


def test_sums_of_targets_are_the_slopes_of_what_sets_them_apart():
    session = labelled_session_of(measured_plate(0))
    measurement = measurement_of(session, prepare_capture(session))
    T_mount = measured_plate(0).T_mount
    own = measurement.capture
    freed = unconstrained_poses(own, own.poses(T_mount), 2.0)
    term = term_of(measurement, EFFECTS["range_scale"])
    sums, g = view_responses(measurement, Model(T_mount), [term], freed)[0].points, freed.overlaps.gram
    step = 0.01 * term.parameters[0].typical
    pulls, squares = [], []
    for sign in (1, -1):
        correction = target_correction(measurement, (term.at([sign * step]),), freed.poses)
        moved = replace(own.sightings, points=own.sightings.points + correction)
        pairs = target_pairs(moved, freed.poses)
        both = append_targets(no_surface(VIEWS, g.centre, g.variance), pairs, 1.0)
        pulls.append(both.vector[both.labelled])
        squares.append(both.square[both.labelled])
    # Σ w e² changes by 2 Σ w g e.
    slopes = (pulls[0] - pulls[1]) / (2 * step), (squares[0] - squares[1]) / (4 * step)
    for slope, own_sums in zip(slopes, (sums.vector[..., 0], sums.residual[:, 0]), strict=True):
        np.testing.assert_allclose(slope, own_sums[g.labelled], atol=1e-3 * np.abs(own_sums[g.labelled]).max())
