"""Partners of many views: what they tell of the poses, and pairs that nothing stands in for."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from data_synth.fixtures.blade_cells import captured_blade
from stitch.numerics import frames
from stitch.observations.surfaces import partners
from stitch.observations.surfaces.normal_equations import collect_overlaps, common_samples, next_gate
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.session.capture import Capture

VIEWS = 44


def test_poses_of_many_views_lie_as_near_the_truth_as_with_all_partners(monkeypatch):
    """Mean square displacement along the normals, after the motion common to all: no 5 % more, in two cells."""
    squares = []
    usual = partners._ALL_PARTNERS
    for seed in range(2):
        measured, capture = captured_blade(seed, views=VIEWS)
        truth = measured.T_reference_scanner
        gate = next_gate(collect_overlaps(capture, truth, 3.0, common_samples(capture.scans, 600)), capture)
        for most in (usual, VIEWS):
            monkeypatch.setattr(partners, "_ALL_PARTNERS", most)
            found = unconstrained_poses(capture, truth, gate)
            squares.append((len(found.overlaps.pairs), _mean_square(capture, truth, found.poses)))
    pairs, square = np.array(squares).reshape(2, 2, 2).sum(axis=0).T
    assert pairs[0] < 0.95 * pairs[1]
    assert square[0] < 1.05 * square[1]


def _mean_square(capture: Capture, truth: NDArray[np.float64], poses: NDArray[np.float64]) -> float:
    rows, off = [], []
    for scan, right, T in zip(capture.scans, truth, poses, strict=True):
        points, normals = frames.transform(right, scan.points), frames.rotate(right, scan.normals)
        rows.append(frames.plane_rows(points, normals))
        off.append(np.einsum("ni,ni->n", frames.transform(T, scan.points) - points, normals))
    A, d = np.concatenate(rows), np.concatenate(off)
    return float(np.mean((d - A @ np.linalg.lstsq(A, d, rcond=None)[0]) ** 2))


def test_a_bridge_between_two_groups_of_views_is_kept():
    """Each view of either group has 49 partners that show more of it than the one that holds the groups together."""
    shares = np.full((100, 100), 1.0) - np.eye(100)
    shares[:50, 50:] = shares[50:, :50] = 0.0
    shares[7, 60] = shares[60, 7] = 0.1
    kept = partners._best_of(shares, shares > 0)
    assert (kept == kept.T).all() and (kept <= (shares > 0)).all()
    assert kept[7, 60] and connected_components(coo_array(kept))[0] == 1
    assert kept.sum(axis=1).min() >= 20 and kept.sum() < 0.7 * (shares > 0).sum()


def test_an_edge_counts_by_what_stands_in_for_it():
    """Leverages of a spanning tree's edges are 1, and those of any connected graph sum to its nodes less one (Foster)."""
    rng = np.random.default_rng(0)
    tree = np.zeros((9, 9))
    for v in range(1, 9):
        tree[v, rng.integers(v)] = rng.uniform(0.1, 2.0)
    assert np.allclose(partners._leverage(tree + tree.T)[tree + tree.T > 0], 1.0)
    graph = np.zeros((9, 9))
    for v, w in combinations(range(9), 2):
        graph[v, w] = graph[w, v] = rng.uniform(0.1, 2.0)
    assert np.isclose(partners._leverage(graph).sum() / 2, 8.0)
