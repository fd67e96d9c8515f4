"""Circles and spheres fitted to one scan, with outliers, a table and a wall."""

import numpy as np
import pytest

from data_synth.fixtures.sphere_scans import RADIUS, area_scan, line_scan
from stitch.errors import InputError
from stitch.plugins.intake.detection.balls import fit_ball
from stitch.plugins.metrology.calibrate.sphere_fit import sphere_view


def test_circle_and_sphere_with_a_third_of_outliers():
    rng = np.random.default_rng(0)
    for scan, k in ((line_scan, [0, 2]), (area_scan, [0, 1, 2])):
        centre = np.array([3.0, 12.0, 80.0])
        points = scan(centre, rng, 0.01)[:, k]
        bad = rng.random(len(points)) < 0.3
        points[bad] += rng.normal(0, 15, points[bad].shape)
        ball = fit_ball(points, RADIUS)
        assert ball.centre == pytest.approx(centre[k], abs=0.02)
        assert ball.keep[~bad].mean() > 0.98 and ball.keep[bad].mean() < 0.1


def test_jacobian_free_check_of_the_covariance_of_a_circle():
    """Covariance of centre and radius against their scatter over noise."""
    found = [
        fit_ball(line_scan(np.array([0.0, 10, 80]), np.random.default_rng(s), 0.02)[:, [0, 2]], RADIUS)
        for s in range(60)
    ]
    scatter = np.std([[*b.centre, b.radius] for b in found], axis=0)
    # Noise along z shows to the extent that the arc faces z: less than radial noise would.
    assert np.all(scatter < 1.2 * np.sqrt(np.diag(found[0].covariance)))


def test_a_sphere_on_a_table_is_found():
    """A table of many more points than the sphere has, and a wall."""
    rng = np.random.default_rng(1)
    centre = np.array([5.0, -8, 400])
    table = np.column_stack([rng.uniform(-300, 300, (4000, 2)), 430 + rng.normal(0, 0.02, 4000)])
    wall = np.column_stack([rng.uniform(-300, 300, 2000), np.full(2000, 250.0), rng.uniform(200, 430, 2000)])
    view = sphere_view("v", np.concatenate([table, wall, area_scan(centre, rng, 0.02)]), RADIUS)
    assert view.foot == pytest.approx(centre, abs=0.02)
    assert view.dropped > 5900
    with pytest.raises(InputError, match="no sphere of radius"):
        sphere_view("v", np.concatenate([table, wall]), RADIUS)
