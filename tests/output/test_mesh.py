"""The mesh of a fused cloud: a ball's known area and volume, open edges, thin sheets, the file."""

import numpy as np
import pytest
import trimesh

from stitch.errors import NoResultError
from stitch.output.mesh import mesh_of, write_mesh

RADIUS = 50.0


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


def test_both_sides_of_a_sheet_two_spacings_thick():
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
