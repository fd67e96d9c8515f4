"""Meshes of known bodies: a ball, a ball that nobody saw from below, a sheet, what is no surface, the file; open, closed and light."""

import numpy as np
import pytest
import trimesh

from stitch.errors import NoResultError
from stitch.output.mesh import mesh_of, write_mesh
from stitch.output.open3d_mesh import MeshFit, make_mesh, watertight
from stitch.run_data import FusedCloud
from tests.needs import needs_open3d

RADIUS = 50.0
NOISE = 0.05


def ball(count: int) -> np.ndarray:
    """Unit vectors spread evenly: a Fibonacci lattice."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + np.sqrt(5)) * i
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])


def spacing(count: int) -> float:
    return float(np.sqrt(4 * np.pi * RADIUS**2 / count))


def test_a_ball_is_closed_and_has_its_area_and_volume():
    count, noise = 20_000, 0.05
    n = ball(count)
    points = n * (RADIUS + noise * np.random.default_rng(0).normal(size=(count, 1)))
    mesh = mesh_of(points, n)
    solid = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    assert solid.is_watertight and solid.is_winding_consistent and solid.body_count == 1
    # Chords of a cell's diagonal cut at most 3·spacing²/8R off the radius; the noise of all points is averaged.
    sag = 3 * spacing(count) ** 2 / (8 * RADIUS)
    assert -sag < np.cbrt(solid.volume / (4 / 3 * np.pi)) - RADIUS < 4 * noise / np.sqrt(count)
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert np.std(radii) < noise
    assert solid.volume > 0  # outwards
    assert solid.area == pytest.approx(4 * np.pi * RADIUS**2, rel=5e-3)


def test_nothing_is_closed_that_nobody_saw():
    count = 20_000
    n = ball(count)
    n = n[n[:, 2] > 0]
    mesh = mesh_of(RADIUS * n, n)
    half = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    edges = half.edges_sorted[trimesh.grouping.group_rows(half.edges_sorted, require_count=1)]
    assert np.abs(half.vertices[edges][:, :, 2]).max() < 2.5 * spacing(count)
    assert half.area == pytest.approx(2 * np.pi * RADIUS**2, rel=2.5 * spacing(count) / RADIUS)


def test_a_sheet_two_spacings_thick_keeps_both_sides():
    side = np.stack(np.meshgrid(*[np.arange(-20, 20.1, 0.5)] * 2), axis=-1).reshape(-1, 2)
    points = np.vstack([np.column_stack([side, np.full(len(side), z)]) for z in (0.5, -0.5)])
    normals = np.repeat([[0, 0, 1.0], [0, 0, -1.0]], len(side), axis=0)
    mesh = mesh_of(points, normals)
    assert np.abs(np.abs(mesh.vertices[:, 2]) - 0.5).max() < 1e-6
    for sign in (1, -1):
        one = mesh.triangles[(sign * mesh.vertices[mesh.triangles][:, :, 2] > 0).all(axis=1)]
        area = trimesh.Trimesh(mesh.vertices, one, process=False).area
        assert 40.0**2 < area < (40.0 + 4 * 0.5 + 2 * 0.5) ** 2


def test_the_file_holds_the_mesh(tmp_path):
    n = ball(3000)
    mesh = mesh_of(RADIUS * n, n)
    write_mesh(mesh, tmp_path / "mesh.ply")
    read = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    assert np.array_equal(read.vertices, mesh.vertices) and np.array_equal(read.faces, mesh.triangles)


def test_a_single_point_is_no_surface(tmp_path):
    with pytest.raises(NoResultError, match="no surface"):
        mesh_of(np.zeros((1, 3)), np.array([[0, 0, 1.0]]))


@pytest.fixture
def open3d():
    """Open3D, without which there are no such meshes."""
    return needs_open3d()


def cloud(normals: np.ndarray) -> FusedCloud:
    """Points of the ball with noise, where it has these normals."""
    away = RADIUS + NOISE * np.random.default_rng(0).normal(size=(len(normals), 1))
    return FusedCloud(away * normals, normals, np.zeros(len(normals)), np.ones(len(normals), int))


def solid(mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)


@pytest.mark.usefixtures("open3d")
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


@pytest.mark.usefixtures("open3d")
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


@pytest.mark.usefixtures("open3d")
def test_two_bodies_stay_two():
    n = ball(4000)
    points = np.vstack([RADIUS * n, RADIUS * n + [0, 0, 3 * RADIUS]])
    body = solid(watertight(points, np.vstack([n, n])))
    assert body.is_watertight and body.body_count == 2
    assert body.volume == pytest.approx(2 * 4 / 3 * np.pi * RADIUS**3, rel=5e-3)


@pytest.mark.usefixtures("open3d")
def test_a_light_mesh_has_a_tenth_of_the_triangles_and_the_same_edge():
    upper = cloud(ball(8000)[:4000])
    whole = mesh_of(upper.points, upper.normals)
    mesh, fit = make_mesh(upper, "light")
    assert len(mesh.triangles) == pytest.approx(0.1 * len(whole.triangles), rel=0.01) and not fit.closed
    assert solid(mesh).area == pytest.approx(solid(whole).area, rel=0.01)
    # Ten times as large triangles sag ten times as far.
    assert fit.p95 < MeshFit(whole, upper.points).p95 + 10 * 3 * spacing(8000) ** 2 / (8 * RADIUS)
    assert "open" in fit.sentence("mm")


@pytest.mark.usefixtures("open3d")
def test_points_in_a_line_are_no_surface():
    with pytest.raises(NoResultError, match="no surface"):
        watertight(np.zeros((50, 3)), np.tile([0, 0, 1.0], (50, 1)))
