"""Feature matching: histograms against the paper's formulas point by point, motions against the true ones."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from data_synth.fixtures.quiet_scenes import mesh_of
from stitch.numerics import frames
from stitch.numerics.feature_matching import align_icp, compute_fpfh, register_ransac, voxel_downsample


def samples(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a blade, which no motion maps onto itself."""
    mesh = mesh_of("blade")
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.array(points), np.array(mesh.face_normals[faces])


def darboux_bins(p, n, q, m) -> tuple[int, int, int]:
    """Bins of the three angles between two points with normals (Rusu, Blodow & Beetz 2009, equation 1)."""
    line = (q - p) / np.linalg.norm(q - p)
    if abs(n @ line) < abs(m @ line):
        n, m, line = m, n, -line
    v = np.cross(line, n)
    v /= np.linalg.norm(v)
    angles = np.arctan2(np.cross(n, v) @ m, n @ m), v @ m, n @ line
    shares = (angles[0] + np.pi) / (2 * np.pi), (angles[1] + 1) / 2, (angles[2] + 1) / 2
    return tuple(min(int(11 * share), 10) for share in shares)


def simple_histogram(points, normals, i, radius) -> tuple[np.ndarray, list[tuple[int, float]]]:
    histogram, neighbours = np.zeros((3, 11)), []
    for j in range(len(points)):
        distance = float(np.linalg.norm(points[i] - points[j]))
        if j != i and distance < radius:
            neighbours.append((j, distance))
            for which, bin_ in enumerate(darboux_bins(points[i], normals[i], points[j], normals[j])):
                histogram[which, bin_] += 1
    return 100 * histogram / max(len(neighbours), 1), neighbours


def test_histograms_are_the_papers():
    points, normals = samples(400, 0)
    radius = 15.0
    found = compute_fpfh(points, normals, radius).histograms
    for i in range(0, 400, 40):
        own, neighbours = simple_histogram(points, normals, i, radius)
        assert 3 < len(neighbours) < 99
        around = sum(simple_histogram(points, normals, j, radius)[0] / d**2 for j, d in neighbours)
        around *= 100 / around.sum(axis=1, keepdims=True)
        np.testing.assert_allclose(found[i].reshape(3, 11), own + around, atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_the_motion_between_two_samples_of_half_a_part_is_found(seed):
    """Upper four fifths and lower four fifths, sampled apart: partners lie within a spacing, not on each other."""
    rng = np.random.default_rng(seed)
    true = frames.make(Rotation.random(rng=rng).as_matrix(), rng.uniform(-500, 500, 3))
    size = 6.0
    surfaces = []
    for number, (side, T) in enumerate([(1, np.eye(4)), (-1, true)]):
        points, normals = samples(40_000, 10 * seed + number)
        seen = side * (points[:, 2] - 100) > -60
        points, normals = voxel_downsample(points[seen], normals[seen], size / 2)
        surfaces.append(compute_fpfh(frames.transform(T, points), frames.rotate(T, normals), 2.5 * size))
    coarse = register_ransac(surfaces[0], surfaces[1], reach=1.5 * size, draws=10_000)
    corners = trimesh.bounds.corners(mesh_of("blade").bounds)
    off = frames.transform(coarse, corners) - frames.transform(true, corners)
    assert np.linalg.norm(off, axis=1).max() < 2 * 1.5 * size
    fine = align_icp(surfaces[0], surfaces[1], coarse, reach=size)
    off = frames.transform(fine, corners) - frames.transform(true, corners)
    assert np.linalg.norm(off, axis=1).max() < size / 4


def test_the_same_surfaces_give_the_same_motion_bit_for_bit():
    a, b = (compute_fpfh(*samples(800, seed), 15.0) for seed in (1, 2))
    assert np.array_equal(register_ransac(a, b, 9.0, 2000, seed=3), register_ransac(a, b, 9.0, 2000, seed=3))


def test_surfaces_with_nothing_in_common_give_no_motion():
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    one = compute_fpfh(points, np.tile([0, 0, 1.0], (5, 1)), 0.5)
    other = compute_fpfh(1e3 * points, np.tile([0, 0, 1.0], (5, 1)), 0.5)
    assert np.array_equal(register_ransac(one, other, 0.1, 100), np.eye(4))
