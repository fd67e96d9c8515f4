"""Closed and light meshes of known bodies: a ball, a ball that nobody saw from below, a sheet, and what is no surface."""

import numpy as np
import pytest
import trimesh

from stitch.errors import NoResultError
from stitch.output.mesh import mesh_of
from stitch.output.open3d_mesh import make_mesh, mesh_fit, watertight
from stitch.run_data import FusedCloud
from tests.needs import needs_open3d
from tests.output.test_mesh import RADIUS, ball, spacing

NOISE = 0.05


@pytest.fixture(autouse=True)
def o3d():
    """Open3D, without which there are no such meshes."""
    return needs_open3d()


def cloud(normals: np.ndarray) -> FusedCloud:
    """Points of the ball with noise, where it has these normals."""
    away = RADIUS + NOISE * np.random.default_rng(0).normal(size=(len(normals), 1))
    return FusedCloud(away * normals, normals, np.zeros(len(normals)), np.ones(len(normals), int))


def solid(mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)


def test_a_ball_has_its_volume_and_the_fit_its_noise():
    mesh, fit = make_mesh(cloud(ball(6000)), "watertight")
    body = solid(mesh)
    assert body.is_watertight and body.is_winding_consistent and body.body_count == 1 and fit.closed
    sag = 3 * spacing(6000) ** 2 / (8 * RADIUS)
    assert abs(np.cbrt(body.volume / (4 / 3 * np.pi)) - RADIUS) < sag
    # Half of a normal distribution lies within 0.674 sigma, 95 % within 1.96; the mesh averages some of it.
    assert 0.5 * 0.674 * NOISE < fit.median < 0.674 * NOISE + sag
    assert 0.5 * 1.96 * NOISE < fit.p95 < 1.96 * NOISE + sag
    assert fit.unseen == 0
    again, _ = make_mesh(cloud(ball(6000)), "watertight")
    assert np.array_equal(again.vertices, mesh.vertices) and np.array_equal(again.triangles, mesh.triangles)


def test_what_nobody_saw_is_closed_and_said():
    """A ball without its lower cap, of height h: the lid is a disc, the volume that of the rest."""
    n = ball(9000)
    floor = -0.5
    mesh, fit = make_mesh(cloud(n[n[:, 2] > floor]), "watertight")
    body = solid(mesh)
    assert body.is_watertight and fit.closed
    h = RADIUS * (1 + floor)
    whole = 4 / 3 * np.pi * RADIUS**3 - np.pi * h**2 * (3 * RADIUS - h) / 3
    area = 4 * np.pi * RADIUS**2 - 2 * np.pi * RADIUS * h
    lid = np.pi * RADIUS**2 * (1 - floor**2)
    # The rim may lie a few spacings off the last points.
    rim = 2 * np.pi * RADIUS * np.sqrt(1 - floor**2) * 4 * spacing(9000)
    assert body.volume == pytest.approx(whole, abs=lid * 4 * spacing(9000))
    assert fit.unseen == pytest.approx(lid / (lid + area), abs=2 * rim / area)
    assert "Nobody looked at" in fit.sentence("mm")


def test_two_bodies_stay_two():
    n = ball(4000)
    points = np.vstack([RADIUS * n, RADIUS * n + [0, 0, 3 * RADIUS]])
    body = solid(watertight(points, np.vstack([n, n])))
    assert body.is_watertight and body.body_count == 2
    assert body.volume == pytest.approx(2 * 4 / 3 * np.pi * RADIUS**3, rel=5e-3)


def test_a_light_mesh_has_a_tenth_of_the_triangles_and_the_same_edge():
    upper = cloud(ball(8000)[:4000])
    whole = mesh_of(upper.points, upper.normals)
    mesh, fit = make_mesh(upper, "light")
    assert len(mesh.triangles) == pytest.approx(0.1 * len(whole.triangles), rel=0.01) and not fit.closed
    assert solid(mesh).area == pytest.approx(solid(whole).area, rel=0.01)
    # Ten times as large triangles sag ten times as far.
    assert fit.p95 < mesh_fit(whole, upper.points).p95 + 10 * 3 * spacing(8000) ** 2 / (8 * RADIUS)
    assert "open" in fit.sentence("mm")


def test_points_in_a_line_are_no_surface():
    with pytest.raises(NoResultError, match="no surface"):
        watertight(np.zeros((50, 3)), np.tile([0, 0, 1.0], (50, 1)))
