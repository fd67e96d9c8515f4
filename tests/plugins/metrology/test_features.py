"""Fits and their slopes, against shapes of known size and against the fit repeated with moved points."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from stitch.plugins.metrology.budget import distance_between, number_table
from stitch.plugins.metrology.features import Feature, fit_feature, fit_points, nominal_parameters, reach_of
from stitch.plugins.metrology.place_errors import RunPoints

RNG = np.random.default_rng(5)
TURN = Rotation.from_rotvec([0.4, -0.3, 0.2]).as_matrix()
AT = np.array([30.0, -20.0, 100.0])


def _sphere(n=400):
    normal = RNG.standard_normal((n, 3))
    normal[:, 2] = np.abs(normal[:, 2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return 12.5 * normal, normal


def _cylinder(n=400):
    angle = RNG.uniform(0, 4.0, n)
    normal = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    return 8.0 * normal + np.column_stack([np.zeros((n, 2)), RNG.uniform(-15, 15, n)]), normal


def _plane(n=400):
    return np.column_stack([RNG.uniform(-9, 9, (n, 2)), np.zeros(n)]), np.tile([0.0, 0.0, 1.0], (n, 1))


SHAPES = {
    "sphere": (_sphere, Feature("s", "sphere", at=AT, axis=TURN[:, 2], size=25.0, within=1.0)),
    "cylinder": (_cylinder, Feature("c", "cylinder", at=AT, axis=TURN[:, 2], size=16.0, radius=15.0, within=1.0)),
    "circle": (_cylinder, Feature("k", "circle", at=AT, axis=TURN[:, 2], size=16.0, within=16.0)),
    "plane": (_plane, Feature("p", "plane", at=AT, axis=TURN[:, 2], radius=12.0, within=1.0)),
    "point": (_plane, Feature("q", "point", at=AT, axis=TURN[:, 2], radius=12.0, within=1.0)),
}


def _points(kind, noise=0.0):
    make, feature = SHAPES[kind]
    local, normal = make()
    points = feature.at + (local + noise * RNG.standard_normal((len(local), 1)) * normal) @ feature.R.T
    index = np.arange(len(points))
    return feature, RunPoints(points, normal @ feature.R.T, np.zeros(len(points), int), index)


@pytest.mark.parametrize("kind", SHAPES)
def test_a_shape_without_noise_is_found_exactly(kind):
    feature, points = _points(kind)
    found = fit_feature(feature, points, points.index)
    expected = np.append(feature.size, AT) if feature.size else np.zeros(len(found.values))
    assert np.abs(found.values - expected).max() < 1e-8
    assert found.form < 1e-9


@pytest.mark.parametrize("kind", SHAPES)
def test_slopes_are_those_of_the_fit_repeated(kind):
    feature, points = _points(kind, noise=0.01)
    found = fit_points(feature, points, nominal_parameters(feature))
    moved = 1e-4 * RNG.standard_normal(points.points.shape)
    predicted = np.einsum("qni,ni->q", found.gradient, moved)
    repeated = (found.refit(points.points + moved) - found.refit(points.points - moved)) / 2
    # Residuals of 10 µm against radii of millimetres are what the slopes leave out.
    assert np.abs(repeated - predicted).max() < 0.02 * np.abs(found.gradient).sum(axis=1).max() * 1e-4 + 5e-8


def test_points_far_from_the_nominal_surface_do_not_count():
    feature, points = _points("sphere", noise=0.01)
    off = points.points.copy()
    off[:40] += 0.6 * points.normals[:40]
    found = fit_feature(feature, RunPoints(off, points.normals, points.view, points.index), points.index)
    assert found.values[0] == pytest.approx(25.0, abs=0.01)


def test_a_deviation_counts_from_the_mesh():
    box = trimesh.creation.box([100.0, 100.0, 20.0])
    flat = np.column_stack([RNG.uniform(-5, 5, (300, 2)), np.full(300, 10.07)])
    feature = Feature("d", "deviation", at=np.array([0.0, 0.0, 10.0]), radius=6.0, within=1.0, cad=box)
    points = RunPoints(flat, np.tile([0.0, 0.0, 1.0], (300, 1)), np.zeros(300, int), np.arange(300))
    found = fit_feature(feature, points, points.index)
    assert found.values[0] == pytest.approx(0.07, abs=1e-6)
    assert reach_of(feature) >= 6.0


def test_slopes_of_distances_are_those_of_differences():
    fits = {
        kind: fit_points(*(lambda f, p: (f, p, nominal_parameters(f)))(*_points(kind, noise=0.01))) for kind in SHAPES
    }
    ball, plane = fits["sphere"], fits["plane"]
    wanted = [ball.feature, plane.feature, Feature("x", "distance", between=("p", "s"))]
    _, _, _, slopes = number_table(wanted, [ball, plane])
    values = np.concatenate([ball.values, plane.values])
    for k in range(len(values)):
        step = np.zeros(len(values))
        step[k] = 1e-6
        up, down = (
            distance_between(ball.feature, (values + s)[:4], plane.feature, (values + s)[4:]) for s in (step, -step)
        )
        assert (up - down) / 2e-6 == pytest.approx(slopes[-1, k], abs=1e-3)
